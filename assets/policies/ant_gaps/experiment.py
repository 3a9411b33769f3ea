"""dm_control's ant runs along a corridor whose gaps differ in every episode.

python -m purerl.run ant_gaps

Expected: 18 gaps of 19 in unseen corridors, after 6 min on two CPU cores. Ten seeds: 17.9 gaps
at the lower quartile, 17.2 at least.
"""

from purerl import Config, Evaluation, Experiment, networks
from purerl.envs import run

experiment = Experiment(
    build_env=run.build,
    env=run.Options(body="ant", arena="gaps"),
    build_network=networks.mlp,
    network=networks.MlpOptions(),
    ppo=Config(num_steps=3_000_000),
    evaluation=Evaluation(num_episodes=128, number=6),
)
