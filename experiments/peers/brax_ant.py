"""brax's ant with our settings: brax's own need three times as many steps. Needs brax installed.

python -m purerl.run experiments/peers/brax_ant.py

Expected: return 3,300 after 10 M steps (interquartile mean of 8 seeds; brax's own trainer, with its
published settings: 3,250 after 31 M). `lab/2026-11-24-brax-ant.md` has each seed.
"""

from purerl import Config, Evaluation, Experiment, networks
from purerl.experiments.peers import brax_env

experiment = Experiment(
    build_env=brax_env.build,
    env=brax_env.Options(name="ant", backend="purerl"),
    build_network=networks.mlp,
    network=networks.MlpOptions(min_std=1e-3),
    ppo=Config(
        num_steps=10_000_000,
        rollout_length=64,
        shortest_episode=64,
        num_minibatches=8,
        min_advantage_std=0.0,
        noise_color=0.0,
        entropy_weight=0.08,
        entropy_target=1.0,
    ),
    evaluation=Evaluation(num_episodes=32, number=10),
)
