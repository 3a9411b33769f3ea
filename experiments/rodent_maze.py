"""dm_control's rodent finds treats in a maze that differs in every episode, by sight.

python -m purerl.run rodent_maze --engine warp

After 0.8 M steps it finds 0.4 of 12 treats; not trained further. Running pays only upright: else it
learned to push itself along on its back (`lab/2026-11-30-three-seeds-that-guess.md`).
"""

import dataclasses

from purerl import eyes
from purerl.envs import maze_forage, sight
from purerl.experiments import rodent_two_touch

blind = rodent_two_touch.experiment
experiment = dataclasses.replace(
    blind,
    build_env=maze_forage.build,
    # Treats alone are too rare to learn to walk from.
    env=maze_forage.Options(eyes=sight.Sight(number=2), forward_weight=0.5),
    build_network=eyes.recurrent,
    network=eyes.RecurrentOptions(**vars(blind.network), encoder=(256,)),
)
