"""dm_control's rodent climbs out of a bowl of bumps that differ in every episode.

python -m purerl.run rodent_bowl --engine warp --num-seeds 3

Expected: it climbs out, which is 6 m away, and gallops on: in 75, 102 and 94 of 128 bowls, 25, 38
and 36% of the time being spent outside. Three seeds, 21 M steps each, took 22 min on one H200 with
another training beside. How it came about: `lab/2026-11-30-out-of-the-bowl.md`.
"""

import dataclasses

from purerl import Evaluation, Experiment, networks
from purerl.envs import escape_bowl
from purerl.experiments import rodent_run

experiment = Experiment(
    build_env=escape_bowl.build,
    env=escape_bowl.Options(),
    build_network=networks.mlp,
    network=rodent_run.experiment.network,
    ppo=dataclasses.replace(
        rodent_run.experiment.ppo,
        num_steps=21_000_000,
        num_envs=512,
        rollout_length=32,
        num_minibatches=32,  # of 512 steps, as with 64 environments of 128
        episode_length=1000,  # 20 s
    ),
    evaluation=Evaluation(num_episodes=32, number=8),
)
