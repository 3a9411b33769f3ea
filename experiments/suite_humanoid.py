"""The control suite's humanoids, for a GPU: more environments, and a wider network.

python -m purerl.run suite_humanoid --env.task humanoid-stand --engine warp --num-seeds 5

Expected, of 1000, with five seeds in 10.5 min on one H200: humanoid-stand 963, humanoid-walk 889,
humanoid-run 332. It gets up within 2 s. On a CPU core one seed takes hours.
"""

import dataclasses

from envs.suite import tasks
from experiments import suite

experiment = dataclasses.replace(
    suite.experiment,
    env=tasks.Options(task="humanoid-walk"),
    network=dataclasses.replace(
        suite.experiment.network,
        policy_hidden=(256, 256),  # with 128, a humanoid learned to walk, and not to stand
        value_hidden=(256, 256),
    ),
    ppo=dataclasses.replace(
        suite.experiment.ppo,
        num_steps=50_000_000,
        num_envs=1024,  # with 64, some seeds of humanoid-walk began, and one of humanoid-stand
        rollout_length=32,  # of 128 steps, with 32 minibatches: no humanoid began in 44 M steps
        learning_rate=5e-4,  # a step in 21 actions goes further
        entropy_weight=0.001,  # with 0.01, the bonus outweighs what one action of 21 can earn
    ),
)
