"""dm_control's control suite, the 28 tasks of its benchmark, with one set of settings.

python -m purerl.run suite --env.task cheetah-run --name cheetah-run

Expected: return 908 of 1000 after 10 min, on one CPU core; others: lab/2026-11-28-control-suite.md.
The settings are the defaults: `purerl/ppo/config.py` and `networks.py` say why. Humanoids learn
nothing with these: `suite_humanoid` has settings for them. A GPU: `suite_gpu`.
"""

from purerl import Config, Evaluation, Experiment, networks
from purerl.envs.suite import tasks

experiment = Experiment(
    build_env=tasks.build,
    env=tasks.Options(),
    build_network=networks.mlp,
    network=networks.MlpOptions(),
    ppo=Config(num_steps=10_000_000),
    evaluation=Evaluation(num_episodes=32, number=10),
)
