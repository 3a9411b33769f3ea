"""Playground's CartpoleSwingup in our trainer, with the suite's settings.

python -m purerl.run experiments/peers/playground_peer.py --num-seeds 3 --seed 0

Expected: return 850 of 1000 after 2 M steps; beside Playground's own: docs/measurements/peers.md.
"""

from purerl import Config, Evaluation, Experiment, adapters, networks

experiment = Experiment(
    build_env=adapters.from_playground,
    env=adapters.PlaygroundOptions("CartpoleSwingup"),
    build_network=networks.mlp,
    network=networks.MlpOptions(policy_hidden=(128, 128), value_hidden=(128, 128)),
    ppo=Config(
        num_steps=5_000_000,
        num_envs=128,
        rollout_length=64,
        learning_rate=1e-3,
        schedule="linear",
        reward_scale=0.1,
    ),
    evaluation=Evaluation(num_episodes=32, number=5),
)
