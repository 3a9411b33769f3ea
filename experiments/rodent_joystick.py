"""dm_control's rodent runs, turns, rears and stops, as it is told.

python -m purerl.run rodent_joystick --engine warp

Expected: after 18 M steps, 4 min on an H200, 434 of 500 are earned in training: it runs at 0.4 to
1.2 m/s, turns, and stands up on its hind legs for as long as it is told. One seed.
"""

import dataclasses

from purerl import Evaluation, Experiment, networks
from purerl.envs import joystick
from purerl.experiments import rodent_gaps

experiment = Experiment(
    build_env=joystick.build,
    env=joystick.Options(),
    build_network=networks.mlp,
    network=rodent_gaps.experiment.network,
    ppo=dataclasses.replace(
        rodent_gaps.experiment.ppo, num_envs=2048, num_minibatches=16, num_steps=20_000_000
    ),
    evaluation=Evaluation(num_episodes=64, number=8),
)
