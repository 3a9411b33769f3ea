"""Cart-pole swing-up: the smallest task worth learning, and the first thing to run.

python -m purerl.run cartpole_swingup

Expected: return 936 or 942 of 1000 after 14 to 21 s, on two CPU cores.
"""

from purerl import Config, Evaluation, Experiment, networks
from purerl.envs import cartpole_swingup

experiment = Experiment(
    build_env=cartpole_swingup.build,
    env=cartpole_swingup.Options(),
    build_network=networks.mlp,
    network=networks.MlpOptions(
        policy_hidden=(64, 64),
        value_hidden=(64, 64),
        activation="tanh",
        initial_std=0.6,
        min_std=1e-3,
    ),
    ppo=Config.plain(  # what `Config` has beyond this brings nothing here
        num_steps=1_000_000,
        rollout_length=64,
        num_minibatches=8,
        learning_rate=1e-3,
        schedule="linear",
    ),
    evaluation=Evaluation(num_episodes=32, number=5),
)
