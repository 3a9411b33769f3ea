"""The control suite's humanoids: the settings of `suite`, but for two numbers.

python -m purerl.run suite_humanoid --env.task humanoid-walk

Expected: return 311 to 409 of 1000 with four of five seeds, and 8 with the fifth; 38 min on one CPU
core. It gets up and walks. humanoid-stand and humanoid-run learn nothing in as many steps.
"""

import dataclasses

from envs.suite import tasks
from experiments import suite

experiment = dataclasses.replace(
    suite.experiment,
    env=tasks.Options(task="humanoid-walk"),
    ppo=dataclasses.replace(
        suite.experiment.ppo,
        learning_rate=5e-4,  # a step in 21 actions goes further
        entropy_weight=0.001,  # with 0.01, the bonus outweighs what one action of 21 can earn
    ),
)
