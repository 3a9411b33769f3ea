"""Gymnasium's Ant-v5, to compare with other trainers (`python -m experiments.peers.sb3`).

python -m pip install -c constraints.txt -e '.[peers]'
python -m purerl.run experiments/peers/gymnasium_ant.py
"""

from envs import gymnasium_ant
from purerl.ppo import networks
from purerl.ppo.config import Config, Evaluation
from purerl.runs.experiment import Experiment

experiment = Experiment(
    build_env=gymnasium_ant.build,
    env=gymnasium_ant.Options(),
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
        gamma=0.99,
        reward_scale=0.1,
    ),
    evaluation=Evaluation(num_episodes=32, number=10),
)
