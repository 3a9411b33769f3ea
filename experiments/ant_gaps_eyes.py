"""dm_control's ant runs along a corridor of gaps that nothing tells it of: it has to see.


python -m purerl.run ant_gaps_eyes
"""

import dataclasses

from purerl import eyes
from purerl.envs import sight
from purerl.experiments import ant_gaps

told = ant_gaps.experiment
experiment = dataclasses.replace(
    told,
    env=dataclasses.replace(told.env, eyes=sight.Sight(number=1, reach=8.0, check=0.5)),
    build_network=eyes.mlp,
    network=eyes.MlpOptions(),
    ppo=dataclasses.replace(told.ppo, num_steps=4_000_000),
)
