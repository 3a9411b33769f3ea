r"""dm_control's rodent moves as recorded rats, or other rodents, did.

python -m purerl.run rodent_imitation --env.clips motion.h5 --env.clip-set train
"""

from purerl import Config, Evaluation, Experiment, networks
from purerl.envs import imitation
from purerl.experiments import humanoid_imitation

experiment = Experiment(
    build_env=imitation.build,
    env=imitation.Options(body="rodent"),
    build_network=humanoid_imitation.build_network,
    network=networks.MlpOptions(
        policy_hidden=(256, 256), value_hidden=(256, 256), initial_std=0.3, min_std=1e-3
    ),
    ppo=Config(
        num_steps=3_000_000,
        rollout_length=64,
        num_minibatches=8,
        gamma=0.95,
        episode_length=200,  # 2 s
        learning_rate=3e-4,
        entropy_weight=0.0,
    ),
    evaluation=Evaluation(num_episodes=64, number=10),
)
