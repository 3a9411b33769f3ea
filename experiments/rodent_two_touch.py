"""dm_control's rodent taps an orb, waits 0.8 s, and taps it again.

python -m purerl.run rodent_two_touch --engine warp

It is told where the orb is, but not when it was tapped. The settings are those that an ant learned
it with (`ant_two_touch`). Not learned: after 18 M steps of three seeds, on a GPU (`--ppo.num-envs
512 --ppo.rollout-length 32 --ppo.num-minibatches 32 --ppo.num-steps 18000000`), it taps 8 to 10
orbs in 30 s, 11 to 25% of its second taps are right, and it lies on its back.
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
