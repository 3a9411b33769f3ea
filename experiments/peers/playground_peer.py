"""Playground's CartpoleSwingup in our trainer, with plain PPO.

python -m purerl.run experiments/peers/playground_peer.py --num-seeds 3 --seed 0

Expected: return 850 of 1000 after 2 M steps; beside Playground's own: lab/2026-11-24-playground.md.
"""

from purerl import Config, Evaluation, Experiment, adapters, networks

experiment = Experiment(
    build_env=adapters.from_playground,
    env=adapters.PlaygroundOptions("CartpoleSwingup"),
    build_network=networks.mlp,
    network=networks.MlpOptions(initial_std=0.6, min_std=1e-3),
    ppo=Config.plain(
        num_steps=5_000_000,
        num_envs=128,
        rollout_length=64,
        num_minibatches=8,
        schedule="linear",
        reward_scale=0.1,
    ),
    evaluation=Evaluation(num_episodes=32, number=5),
)
