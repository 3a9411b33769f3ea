"""dm_control's rodent runs along a corridor of gaps that it has to see.

python -m purerl.run rodent_gaps_eyes --engine warp --num-seeds 3

Expected: 3.5 to 3.8 gaps in 10 s after 24 M steps, 20 min on an H200 (three seeds); a falling
learning rate gains nothing more. The told one of `rodent_gaps` is there after 12 M, and crosses 17
after 28 M. In half of a bound its eyes see the sky, and this network has no memory
(`lab/2026-11-29-three-rodents-by-sight.md`).
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
