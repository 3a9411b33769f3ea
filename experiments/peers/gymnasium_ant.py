"""Gymnasium's Ant-v5, to compare with other trainers (`python -m purerl.experiments.peers.sb3`).

python -m pip install -c constraints.txt -e '.[peers]'
python -m purerl.run experiments/peers/gymnasium_ant.py
"""

from purerl.envs import gymnasium_ant
from purerl.experiment.definition import Experiment
from purerl.ppo import networks
from purerl.ppo.config import Config, Evaluation

experiment = Experiment(
    build_env=gymnasium_ant.build,
    env=gymnasium_ant.Options(),
    build_network=networks.mlp,
    network=networks.MlpOptions(initial_std=0.6, min_std=1e-3),
    ppo=Config.plain(
        num_steps=5_000_000,
        num_envs=256,
        rollout_length=32,
        num_minibatches=8,
        learning_rate=3e-4,
        schedule="adaptive_kl",
        reward_scale=0.1,
    ),
    evaluation=Evaluation(num_episodes=32, number=10),
)
