"""dm_control's rodent runs along a corridor whose gaps differ in every episode.

python -m purerl.run rodent_gaps

Measured after 6.5 M steps (29 min on two CPU cores, partly shared), in 128 unseen corridors: 1.5
gaps crossed on average, one or more in 73%, five or more in 5%; the policy of `rodent_run`, which
does not see them, 1.0; standing still, none. It gallops head first at 0.8 m/s and falls into the
wider gaps. Tried in vain: a target of 1.5 m/s at a rate of 2e-4 (at 2.4 M steps it dives into the
first gap), a rate of 1e-4 from the start (behind at 0.9 M).
"""

from envs import run
from purerl import networks
from purerl.config import Config
from purerl.experiment import Evaluation, Experiment

experiment = Experiment(
    build_env=run.build,
    env=run.Options(
        body="rodent",
        arena="gaps",
        platform_length=(0.4, 0.8),
        gap_length=(0.05, 0.2),
        corridor_width=2.0,
        # Speed without a bound pays best in a sprint that ends in the first gap.
        reward="target",
        target_speed=0.8,
    ),
    build_network=networks.mlp,
    # A scale that depends on what it feels lets it run with noise and step across without.
    network=networks.MlpOptions(
        policy_hidden=(256, 256), value_hidden=(256, 256), std="state", initial_std=0.3
    ),
    ppo=Config(
        num_steps=6_500_000,
        num_envs=256,
        rollout_length=32,
        num_epochs=4,
        num_minibatches=8,
        episode_length=500,  # 10 s
        learning_rate=3e-4,
        schedule="linear",
        gamma=0.99,
    ),
    evaluation=Evaluation(num_episodes=32, number=10),
)
