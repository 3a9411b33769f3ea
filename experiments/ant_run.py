"""dm_control's ant runs forward on a floor.

python -m purerl.run ant_run

Expected: 4.8 m/s after 9 to 13 min, two seeds at a time on two CPU cores.
Ten seeds: 4.72 m/s at the lower quartile, 4.61 at least.
"""

from envs import run
from purerl import Config, Evaluation, Experiment, networks

experiment = Experiment(
    build_env=run.build,
    env=run.Options(body="ant"),
    build_network=networks.mlp,
    network=networks.MlpOptions(
        policy_hidden=(128, 128), value_hidden=(128, 128), initial_std=1.0, min_std=0.2
    ),
    ppo=Config(  # the control suite's settings: `suite.py` says why
        num_steps=5_000_000,
        num_envs=64,
        rollout_length=128,
        shortest_episode=32,
        num_epochs=4,
        num_minibatches=16,
        noise_color=0.75,
        min_advantage_std=0.01,
        learning_rate=1e-3,
        schedule="linear",
        advantage_clip=4.0,
        entropy_weight=0.01,
        entropy_target=0.3,
        reward_scaling="return_std",
    ),
    evaluation=Evaluation(num_episodes=32, number=10),
)
