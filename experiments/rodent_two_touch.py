"""dm_control's rodent taps an orb, waits 0.8 s, and taps it again: it needs a memory.

python -m purerl.run rodent_two_touch --engine warp --num-seeds 3

Expected: 18 and 19 orbs in 30 s, 79 and 93% of their second taps at the right time, two of three
seeds after 12.9 M steps, 20 min on a third of an H200; the third seed taps 12, a second time too
late. Without a memory (`networks.mlp`) three seeds tap 8 or 9 orbs, most of them too late. It rears
to tap, and stands on its feet between.

It is told where the orb is, but not when it was tapped. dm_control's reward for being near is five
times as much; with that it lies on its back, all feet at the orb, and waits.
"""

import dataclasses

from purerl import Evaluation, Experiment, networks
from purerl.envs import sight, two_touch
from purerl.experiments import rodent_run

told = rodent_run.experiment
experiment = Experiment(
    build_env=two_touch.build,
    env=two_touch.Options(
        eyes=sight.Sight(number=0), area=0.3, soon_cost=10.0, near=0.002, least_up=-0.3
    ),
    build_network=networks.recurrent,
    network=networks.RecurrentOptions(**vars(told.network)),
    ppo=dataclasses.replace(
        told.ppo,
        num_steps=16_000_000,
        num_envs=512,
        rollout_length=32,
        episode_length=1500,  # 30 s
    ),
    evaluation=Evaluation(num_episodes=32, number=10),
)
