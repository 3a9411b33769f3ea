"""dm_control's rodent finds treats in a new maze each episode, told where the nearest is.

python -m purerl.run rodent_maze --engine warp --num-seeds 3

Expected: 10.4, 10.5 and 10.7 of 12 treats in 30 s, three seeds, after 7 M steps of each, in 7 min
on one H200 (128 mazes each); two thirds of the episodes end sooner, with all of them found. It runs
on its feet; in 7% of the episodes it lies on its back, and finds half as many. By sight:
`rodent_maze_eyes`. How it came about: `lab/2026-11-30-treats-told.md`.
"""

import dataclasses

from purerl import Evaluation, Experiment, networks
from purerl.envs import maze_forage, sight
from purerl.experiments import rodent_run

experiment = Experiment(
    build_env=maze_forage.build,
    # Treats alone are too rare to learn to walk from.
    env=maze_forage.Options(eyes=sight.Sight(number=0), forward_weight=0.5),
    build_network=networks.mlp,
    network=rodent_run.experiment.network,
    ppo=dataclasses.replace(
        rodent_run.experiment.ppo,
        num_steps=9_000_000,
        num_envs=512,
        rollout_length=32,
        episode_length=1500,  # 30 s
    ),
    evaluation=Evaluation(num_episodes=32, number=8),
)
