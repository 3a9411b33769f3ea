"""dm_control's ant runs along a corridor whose gaps differ in every episode.

python -m purerl.run ant_gaps

Expected: 15 gaps of 19, 5 or more in 93% of unseen corridors, after 4 min on two CPU cores (seeds 2
and 3: 16 gaps, 90% and 100%). Ten seeds with MJX-Warp: 14.3 gaps at the lower quartile, 14.0 at
least.
"""

from envs import run
from purerl import Config, Evaluation, Experiment, networks

experiment = Experiment(
    build_env=run.build,
    env=run.Options(body="ant", arena="gaps"),
    build_network=networks.mlp,
    network=networks.MlpOptions(),
    ppo=Config(num_steps=3_000_000),
    evaluation=Evaluation(num_episodes=128, number=6),
)
