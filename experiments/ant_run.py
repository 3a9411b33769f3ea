"""dm_control's ant runs forward on a floor.

python -m purerl.run ant_run

Expected: 4.5 m/s after 3.6 min, on two CPU cores (seeds 2 and 3: 4.5 and 4.6 m/s).
Ten seeds with MJX-Warp: 4.1 m/s at the lower quartile, 3.8 at least.
"""

from envs import run
from purerl import Config, Evaluation, Experiment, networks

experiment = Experiment(
    build_env=run.build,
    env=run.Options(body="ant"),
    build_network=networks.mlp,
    network=networks.MlpOptions(policy_hidden=(128, 128), value_hidden=(128, 128)),
    ppo=Config(
        num_steps=5_000_000,
        num_envs=256,
        rollout_length=32,
        num_epochs=4,
        num_minibatches=8,
        learning_rate=3e-4,
        schedule="adaptive_kl",
        gamma=0.98,
        reward_scale=0.05,
    ),
    evaluation=Evaluation(num_episodes=32, number=10),
)
