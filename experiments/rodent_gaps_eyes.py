"""dm_control's rodent runs along a corridor of gaps that it has to see.

python -m purerl.run rodent_gaps_eyes --engine warp --num-seeds 3
python -m purerl.run rodent_gaps_eyes --ppo.num-envs 256 --ppo.num-steps 2000000

It guesses where the gaps are from its pictures, what it feels and its memory, and moves as the told
one of `rodent_gaps` does, whose policy it has: `guessing.py` has the network.

Expected of the first command: 14.2 gaps in 10 s, each of three seeds (128 corridors), after 11 min
on one H200; of the second, one seed: 11.4 after 50 min on two CPU cores. The told one crosses 17.
With its left eye closed it crosses 5.7, with the right one 3.0
(`lab/2026-11-30-three-seeds-that-guess.md`). A policy of its own crosses 3.5 to 3.8 after 24 M
steps (`lab/2026-11-30-a-guess-of-what-the-other-was-told.md`).
"""

import dataclasses

from purerl import Experiment, Part
from purerl.envs import sight
from purerl.experiments import guessing, rodent_gaps

told = rodent_gaps.experiment
PART = Part(run="rodent_gaps", reads=("policy", "privileged"), rate=0.0)
experiment: Experiment = dataclasses.replace(
    told,
    env=dataclasses.replace(told.env, eyes=sight.Sight(number=2)),
    build_network=guessing.guess,
    network=guessing.Options(policy=dataclasses.replace(told.network, value_hidden=(128, 128))),
    ppo=dataclasses.replace(
        told.ppo,
        num_steps=8_000_000,
        rollout_length=32,  # a bound takes 0.2 s, 10 steps: its memory learns over three
        learning_rate=1e-3,  # of the guess: the policy stays as it is
        value_weight=0.1,
        auxiliary={"guess": 2.0, "guess_error": 0.0},
    ),
    parts={"policy": PART, "head": PART},
)
