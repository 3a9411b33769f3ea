"""An ant taps an orb, waits 0.8 s, and taps it again, as dm_control's rodent does.

python -m purerl.run ant_two_touch

Expected: 13 to 22 orbs in 30 s, four seeds, and 85, 79, 86 and 52% of their second taps at the
right time, after 6 M steps, 25 min on one CPU core. It has no memory, and is not told when it
tapped: it tells the time by how its body moves. With a memory it is the same. Without the cost of a
tap too soon a leg stays at the orb, and 4% are right.
"""

import dataclasses

from purerl import Evaluation, Experiment, networks
from purerl.envs import sight, two_touch
from purerl.experiments import ant_run

experiment = Experiment(
    build_env=two_touch.build,
    # Orbs are near: of dm_control's +- 1.5 m it would learn to walk first.
    env=two_touch.Options(body="ant", eyes=sight.Sight(number=0), area=0.6, soon_cost=20.0),
    build_network=networks.mlp,
    network=networks.MlpOptions(),
    ppo=dataclasses.replace(
        ant_run.experiment.ppo,
        num_steps=6_000_000,
        episode_length=1200,  # 30 s
    ),
    evaluation=Evaluation(num_episodes=32, number=10),
)
