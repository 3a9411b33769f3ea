"""A fly's front leg moves as a real one did, by 15 muscles.

    python -m purerl.experiments.benchmarks.flies flygym-2.1.1-py3-none-any.whl
    python -m purerl.run purerl.experiments.benchmarks.fly_muscles

The model's lengths are mm, so what metrics call mm is 0.001 mm.
"""

import dataclasses

from purerl.envs.tracking import Term
from purerl.experiments.benchmarks import fly_legs

legs = fly_legs.experiment
experiment = dataclasses.replace(
    legs,
    env=dataclasses.replace(
        legs.env,
        body="leg.xml",
        clips="leg.h5",
        end_effectors=("LFTarsus5", "LFTarsus1", "LFTibia"),
        control_rate=500,
        clip_rate=500,
        farthest_joints=1.5,
        farthest_place=1.0,
        reward=dataclasses.replace(
            legs.env.reward, joints=Term(1.0, 0.3), end_effectors=Term(1.0, 0.2)
        ),
    ),
    ppo=dataclasses.replace(legs.ppo, num_steps=1_000_000, gamma=0.95, episode_length=225),
)
