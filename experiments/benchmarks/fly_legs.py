"""A fly on a tether moves its six legs as a real one did: 42 servos.

    python -m purerl.experiments.benchmarks.flies flygym-2.1.1-py3-none-any.whl
    python -m purerl.run purerl.experiments.benchmarks.fly_legs

The model's lengths are cm, so what metrics call mm is 0.01 mm.
"""

from purerl import Config, Evaluation, Experiment, networks
from purerl.envs import imitation
from purerl.envs.tracking import Reward, Term

OFF = Term(0.0, 1.0)
experiment = Experiment(
    build_env=imitation.build,
    env=imitation.Options(
        body="fly.xml",
        clips="fly.h5",
        end_effectors=tuple(f"claw_T{i}_{side}" for i in (1, 2, 3) for side in ("left", "right")),
        control_rate=100,
        clip_rate=100,
        substeps=20,
        reward=Reward(
            root_position=OFF,
            root_rotation=OFF,
            joints=Term(1.0, 1.0),
            end_effectors=Term(1.0, 0.03),
            height_weight=0.0,
            control_weight=0.0,
            change_weight=0.0,
            energy_weight=0.0,
        ),
    ),
    build_network=imitation.mlp,
    network=networks.MlpOptions(
        policy_hidden=(256, 256), value_hidden=(256, 256), initial_std=0.3, min_std=1e-3
    ),
    ppo=Config(
        num_steps=400_000,
        rollout_length=32,
        num_minibatches=4,
        gamma=0.9,
        episode_length=100,
        learning_rate=3e-4,
        entropy_weight=0.0,
        schedule="linear",
    ),
    evaluation=Evaluation(num_episodes=64, number=10),
)
