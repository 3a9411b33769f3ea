"""dm_control's rodent climbs out of a bowl of bumps that differ in every episode.

python -m purerl.run rodent_bowl

Expected: after 3 M steps, 17 min on four CPU cores, it gets up after the fall and is 1.2 m from the
middle on average: 195 of 1000 (one seed), and rising. Out of the bowl are 6 m: not trained so far.
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
        num_steps=6_000_000,
        episode_length=1000,  # 20 s
    ),
    evaluation=Evaluation(num_episodes=32, number=8),
)
