"""A cart-pole and a network with memory."""

from purerl import Config, Evaluation, Experiment, networks
from purerl.envs import cartpole_swingup

experiment = Experiment(
    build_env=cartpole_swingup.build,
    env=cartpole_swingup.Options(),
    build_network=networks.recurrent,
    network=networks.RecurrentOptions(
        cell="lstm",
        hidden=16,
        encoder=(16,),
        policy_hidden=(16,),
        value_hidden=(16,),
        initial_std=0.6,
        min_std=1e-3,
    ),
    ppo=Config.plain(
        num_steps=768,
        num_envs=16,
        rollout_length=16,
        num_epochs=2,
        num_minibatches=2,
        episode_length=20,
        learning_rate=3e-4,
        entropy_weight=0.01,
        schedule="adaptive_kl",
    ),
    evaluation=Evaluation(num_episodes=4, number=1),
)
