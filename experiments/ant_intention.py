"""dm_control's ant moves as clips of its own kind do, through a code of 8 numbers.

python -m purerl.run ant_intention

Expected: after 2 M steps, 7 to 12 min on two CPU cores (one seed), it keeps up for 67% of the way
to a clip's end, 57% of held-out ones, its joints 5 to 6 deg off, and still gains.

`rodent_intention` is the same of a rodent, and `intention.py` has the network. The clips are 24
episodes of `ant_gaps`, on a floor without the gaps. It controls at 40 Hz, as `ant_gaps_reuse` does.
"""

import dataclasses

from purerl import Evaluation, Experiment
from purerl.envs.tracking import Reward, Term
from purerl.experiments import intention, rodent_intention

rodent = rodent_intention.experiment
experiment: Experiment = dataclasses.replace(
    rodent,
    env=dataclasses.replace(
        rodent.env,
        body="ant",
        clips="ant",
        clip_set="train",
        control_rate=40,
        clip_rate=40,
        farthest_place=0.5,
        farthest_turn=60.0,
        farthest_joints=3.0,
        reward=Reward(
            root_position=Term(1.0, 0.2),
            root_rotation=Term(1.0, 40.0),
            joints=Term(1.0, 0.7),
            end_effectors=Term(1.0, 0.3),
            height_weight=0.0,
            control_weight=0.005,
            change_weight=0.005,
            energy_weight=0.0,
        ),
    ),
    network=intention.ImitationOptions(
        code=8,
        decoder=(128, 128),
        prior=(128, 128),
        encoder=(256, 128),
        value=(256, 128),
        initial_std=0.5,
    ),
    ppo=dataclasses.replace(
        rodent.ppo,
        num_steps=2_000_000,
        num_envs=128,
        rollout_length=32,
        num_minibatches=8,
        episode_length=200,  # 5 s
        learning_rate=5e-4,
        auxiliary={"code_kl": (1e-4, 0.1, 500_000), "prior_kl": 1.0},
    ),
    evaluation=Evaluation(num_episodes=64, number=10),
)
