"""Eyes: what a body sees, as a pure function of where its parts are.

Here belong cameras, the shapes that rays hit, and how light makes an image of them.
"""

from purerl.eyes.eye import Eye as Eye, of_camera as of_camera, pair as pair
from purerl.eyes.networks import (
    Encoder as Encoder,
    MlpOptions as MlpOptions,
    RecurrentOptions as RecurrentOptions,
    mlp as mlp,
    recurrent as recurrent,
)
from purerl.eyes.scene import Eyes as Eyes
