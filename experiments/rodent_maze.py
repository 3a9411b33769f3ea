"""dm_control's rodent finds treats in a maze that differs in every episode, by sight.

python -m purerl.run rodent_maze --engine warp

After 0.8 M steps it finds 0.4 of 12 treats; not trained further.
"""

import dataclasses

from purerl import Evaluation, Experiment, eyes
from purerl.envs import maze_forage, sight
from purerl.experiments import rodent_run

experiment = Experiment(
    build_env=maze_forage.build,
    # Treats alone are too rare to learn to walk from.
    env=maze_forage.Options(eyes=sight.Sight(number=2), forward_weight=0.5),
    build_network=eyes.recurrent,
    network=eyes.RecurrentOptions(
        encoder=(256,), hidden=128, value_hidden=(256,), initial_std=0.3, min_std=1e-3
    ),
    ppo=dataclasses.replace(
        rodent_run.experiment.ppo,
        num_steps=6_000_000,
        episode_length=1500,  # 30 s
    ),
    evaluation=Evaluation(num_episodes=32, number=8),
)
