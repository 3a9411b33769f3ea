r"""dm_control's rodent moves as recordings do, at 100 Hz and with a plain network.

python -m purerl.run rodent_imitation --env.clips motion.h5 --env.clip-set train

Expected: after 1 M steps, 6.5 min on two CPU cores (one seed), it keeps up for 0.4 s of 2 s with
10 s of a gallop of `rodent_gaps_eyes` (1.8 m/s, on a floor without the gaps), its joints 5 deg
off, and still gains. `rodent_intention` has what learned faster.
"""

from purerl import Config, Evaluation, Experiment, networks
from purerl.envs import imitation

experiment = Experiment(
    build_env=imitation.build,
    env=imitation.Options(body="rodent", clips="rodent"),
    build_network=imitation.mlp,
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
