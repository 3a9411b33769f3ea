"""dm_control's rodent taps an orb, waits 0.8 s, and taps it again: it needs a memory.

python -m purerl.run rodent_two_touch

It is told where the orb is, but not when it was tapped. Not learned: after 6 M steps it tapped
twice in 30 s, and one in twenty second taps was right (`lab/2026-11-30-three-seeds-that-guess.md`).
Since then a second tap that is too soon costs, and the policy need not see through its memory, as
of `ant_two_touch`; it was not trained since.
"""

import dataclasses

from purerl import Evaluation, Experiment, networks
from purerl.envs import sight, two_touch
from purerl.experiments import rodent_run

experiment = Experiment(
    build_env=two_touch.build,
    env=two_touch.Options(eyes=sight.Sight(number=0), area=0.3, soon_cost=20.0),
    build_network=networks.recurrent,
    network=networks.RecurrentOptions(
        policy_hidden=(256, 256),
        value_hidden=(256, 256),
        encoder=(256,),
        initial_std=0.3,
        min_std=1e-3,
    ),
    ppo=dataclasses.replace(
        rodent_run.experiment.ppo,
        num_steps=6_000_000,
        episode_length=1500,  # 30 s
    ),
    evaluation=Evaluation(num_episodes=32, number=8),
)
