"""An ant taps an orb, waits 0.8 s, and taps it again: it needs a memory.

python -m purerl.run ant_two_touch
"""

import dataclasses

from purerl import Evaluation, Experiment, networks
from purerl.envs import sight, two_touch
from purerl.experiments import ant_run

experiment = Experiment(
    build_env=two_touch.build,
    env=two_touch.Options(body="ant", eyes=sight.Sight(number=0), area=0.6, soon_cost=20.0),
    build_network=networks.recurrent,
    network=networks.RecurrentOptions(hidden=64),
    ppo=dataclasses.replace(
        ant_run.experiment.ppo,
        episode_length=1200,  # 30 s
    ),
    evaluation=Evaluation(num_episodes=32, number=10),
)
