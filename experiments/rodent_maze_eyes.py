"""dm_control's rodent finds treats in a maze by sight, as one moves that was told.

python -m purerl.run rodent_maze_eyes --parts.policy.run RUN --parts.head.run RUN

RUN is one of `rodent_maze`, such as runs/rodent_maze/seed1. It guesses from its pictures, what it
feels and its memory where the nearest treat is, and moves as that run does, whose policy it has:
`guessing.py` has the network.

Expected: 4.9, 6.1 and 7.0 of 12 treats in 30 s (three seeds, 128 mazes each), where the told one
finds 10.7, after 1.5 M steps, 70 min on two CPU cores or 22 min on six, with `--ppo.num-envs 256
--ppo.rollout-length 64 --ppo.num-steps 1500000`. 8 M were not run.
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
