"""A fly on a tether moves its six legs as a real one did: 42 servos.

    python -m purerl.experiments.benchmarks.flies flygym-2.1.1-py3-none-any.whl
    python -m purerl.run purerl.experiments.benchmarks.fly_legs

The model's lengths are cm, so what metrics call mm is 0.01 mm.
"""

import dataclasses

from purerl import Experiment
from purerl.envs import imitation
from purerl.envs.tracking import Term
from purerl.experiments import humanoid_imitation

OFF = Term(0.0, 1.0)
humanoid = humanoid_imitation.experiment
experiment: Experiment = dataclasses.replace(
    humanoid,
    env=imitation.Options(
        body="fly.xml",
        clips="fly.h5",
        end_effectors=tuple(f"claw_T{i}_{side}" for i in (1, 2, 3) for side in ("left", "right")),
        control_rate=100,
        clip_rate=100,
        substeps=20,
        reward=dataclasses.replace(
            humanoid.env.reward,
            root_position=OFF,
            root_rotation=OFF,
            joints=Term(1.0, 1.0),
            end_effectors=Term(1.0, 0.03),
            change_weight=0.0,
        ),
    ),
    network=dataclasses.replace(humanoid.network, initial_std=0.3),
    ppo=dataclasses.replace(
        humanoid.ppo, num_steps=400_000, gamma=0.9, episode_length=100, schedule="linear"
    ),
)
