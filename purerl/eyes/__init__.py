"""Eyes: what a body sees, as a pure function of where its parts are, and networks that see.

What belongs here: cameras on bodies, the shapes that rays meet, how light makes a picture of them.
May import: core, ppo, physics. Read: `eye.py`, `eyes.py`, `casting.py`; then `networks.py`.
"""

from purerl.eyes.eye import Eye as Eye, of_camera as of_camera, pair as pair, rotation as rotation
from purerl.eyes.eyes import Eyes as Eyes
from purerl.eyes.networks import (
    Encoder as Encoder,
    MlpOptions as MlpOptions,
    RecurrentOptions as RecurrentOptions,
    mlp as mlp,
    recurrent as recurrent,
)
