"""Eyes: what a body sees, as a pure function of where its parts are, and networks that see.

What belongs here: cameras on bodies, the shapes that rays meet, how light makes a picture of them.
May import: core, ppo, physics. Read: `eye.py`, `eyes.py`, `casting.py`; then `networks.py`.
"""

from purerl.eyes.eye import Eye, of_camera, pair, rotation
from purerl.eyes.eyes import Eyes
from purerl.eyes.networks import Convolutions, Encoder, MlpOptions, RecurrentOptions, mlp, recurrent

__all__ = ["Convolutions", "Encoder", "Eye", "Eyes", "MlpOptions", "RecurrentOptions", "mlp"]
__all__ += ["of_camera", "pair", "recurrent", "rotation"]
