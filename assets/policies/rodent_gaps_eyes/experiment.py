"""dm_control's rodent runs along a corridor of gaps that nothing tells it of: it has to see.

python -m purerl.run rodent_gaps_eyes --engine warp --num-seeds 3
"""

import dataclasses

from purerl import eyes
from purerl.envs import sight
from purerl.experiments import rodent_gaps

told = rodent_gaps.experiment
experiment = dataclasses.replace(
    told,
    env=dataclasses.replace(told.env, eyes=sight.Sight(number=2)),
    build_network=eyes.mlp,
    network=eyes.MlpOptions(
        policy_hidden=(256, 256),
        value_hidden=(256, 256),
        std="state",
        initial_std=0.3,
        min_std=1e-3,
    ),
)
