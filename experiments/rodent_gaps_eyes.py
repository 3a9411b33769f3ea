"""dm_control's rodent runs along a corridor of gaps that it has to see.

python -m purerl.run rodent_gaps_eyes --engine warp --num-seeds 2

Expected: 4 to 5 gaps in 10 s after 21 M steps, 15 min on an H200 (two seeds). There the told one of
`rodent_gaps` is then, too, and crosses 17 after 28 M. By sight it was not trained as long.
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
    network=eyes.MlpOptions(**vars(told.network)),
)
