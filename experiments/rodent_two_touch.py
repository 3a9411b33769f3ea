"""dm_control's rodent taps an orb, waits 0.8 s, and taps it again.

python -m purerl.run rodent_two_touch --engine warp

It is told where the orb is, but not when it was tapped. The settings are those that an ant learned
it with (`ant_two_touch`). Not learned yet: after 10.5 M steps three seeds tap 8 to 9 orbs in 30 s,
and 4, 30 and 9% of their second taps are right, rising (512 environments of 32 steps, on a GPU).
"""

import dataclasses

from purerl import Evaluation, Experiment, networks
from purerl.envs import sight, two_touch
from purerl.experiments import rodent_run

experiment = Experiment(
    build_env=two_touch.build,
    env=two_touch.Options(eyes=sight.Sight(number=0), area=0.3, soon_cost=20.0),
    build_network=networks.mlp,
    network=rodent_run.experiment.network,
    ppo=dataclasses.replace(
        rodent_run.experiment.ppo,
        num_steps=12_000_000,
        episode_length=1500,  # 30 s
    ),
    evaluation=Evaluation(num_episodes=32, number=8),
)
