"""dm_control's rodent climbs out of a bowl of bumps that differ in every episode.

python -m purerl.run rodent_bowl

Expected: it gets up after the fall and climbs. After 8 M steps, 16 min on twelve CPU cores, its
head is 3 m from the middle on average and 434 of 1000 are earned (one seed), rising; out of the
bowl are 6 m, where it is 4% of the time.
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
