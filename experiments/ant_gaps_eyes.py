"""dm_control's ant runs along a corridor of gaps that nothing tells it of: it has to see.

python -m purerl.run ant_gaps_eyes

Expected: 18 gaps of 19 in unseen corridors, after 20 min on two CPU cores (one seed).
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
)
