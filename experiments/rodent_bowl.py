r"""dm_control's rodent climbs out of a bowl of bumps that differ in every episode.

With MJX-Warp on a GPU, four seeds at once:

python -m purerl.run rodent_bowl --engine warp --num-seeds 4
"""

from purerl import Config, Evaluation, Experiment, networks
from purerl.envs import escape_bowl

experiment = Experiment(
    build_env=escape_bowl.build,
    env=escape_bowl.Options(),
    build_network=networks.mlp,
    network=networks.MlpOptions(
        policy_hidden=(256, 256),
        value_hidden=(256, 256),
        std="state",
        initial_std=0.3,
        min_std=1e-3,
    ),
    ppo=Config.plain(
        num_steps=64_000_000,
        num_envs=512,
        rollout_length=16,
        num_epochs=4,
        num_minibatches=8,
        episode_length=1000,  # 20 s
        noise_color=0.75,  # as in rodent_gaps
        learning_rate=2e-4,
        schedule="linear",
        gamma=0.99,
        reward_scale=0.1,
    ),
    evaluation=Evaluation(num_episodes=32, number=10),
)
