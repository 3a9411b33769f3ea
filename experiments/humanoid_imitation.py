r"""dm_control's humanoid squats and swings its arms, as a computed clip does.

python -m purerl.run humanoid_imitation

Expected: after 7 min on two CPU cores (29 November 2026, one seed) it keeps up for 2.1 s of 5 s,
its joints 7.5 deg from the clip's (after 0.5 min 0.7 s, 14 deg), and still gains. `--env.clips cmu`
has dm_control's own recordings instead: 0.45 s of a fall.
"""

from purerl import Config, Evaluation, Experiment, networks
from purerl.envs import imitation
from purerl.envs.tracking import Reward, Term

experiment = Experiment(
    build_env=imitation.build,
    env=imitation.Options(
        body="humanoid",
        clips="squats",
        control_rate=50,
        substeps=4,
        farthest_place=0.3,
        farthest_turn=60.0,
        # Servos hold a pose: what an action costs is how far it jumps.
        reward=Reward(
            root_position=Term(1.0, 0.1),
            root_rotation=Term(1.0, 20.0),
            joints=Term(1.0, 2.0),
            end_effectors=Term(1.0, 0.2),
            height_weight=0.0,
            control_weight=0.0,
            change_weight=0.002,
            energy_weight=0.0,
        ),
    ),
    build_network=imitation.mlp,
    network=networks.MlpOptions(
        policy_hidden=(256, 256), value_hidden=(256, 256), initial_std=0.5, min_std=1e-3
    ),
    ppo=Config(
        num_steps=1_200_000,
        # An action of 0 is the middle of each joint's range, far from a stance. How far the policy
        # moves in an update is limited, in its own scale: so small updates, and a large scale.
        rollout_length=32,
        num_minibatches=4,
        gamma=0.95,
        episode_length=250,  # 5 s
        learning_rate=3e-4,
        entropy_weight=0.0,
    ),
    evaluation=Evaluation(num_episodes=64, number=10),
)
