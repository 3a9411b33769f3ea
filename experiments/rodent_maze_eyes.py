"""dm_control's rodent finds treats in a maze by sight, as one moves that was told.

python -m purerl.run rodent_maze_eyes --parts.policy.run RUN --parts.head.run RUN

RUN is one of `rodent_maze`, such as runs/rodent_maze/seed1. It guesses from its pictures, what it
feels and its memory where the nearest treat is, and moves as that run does, whose policy it has:
`guessing.py` has the network.

Expected: TODO
"""

import dataclasses

from purerl import Experiment, Part
from purerl.envs import sight
from purerl.experiments import guessing, rodent_gaps_eyes, rodent_maze

told, like = rodent_maze.experiment, rodent_gaps_eyes.experiment
PART = Part(run="rodent_maze", reads=("policy", "privileged"), rate=0.0)
experiment: Experiment = dataclasses.replace(
    told,
    env=dataclasses.replace(told.env, eyes=sight.Sight(number=2)),
    build_network=guessing.guess,
    network=dataclasses.replace(
        like.network, policy=dataclasses.replace(told.network, value_hidden=(128, 128))
    ),
    ppo=dataclasses.replace(
        told.ppo,
        num_steps=8_000_000,
        learning_rate=like.ppo.learning_rate,
        value_weight=like.ppo.value_weight,
        auxiliary=like.ppo.auxiliary,
    ),
    parts={"policy": PART, "head": PART},
)
