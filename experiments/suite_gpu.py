"""The control suite for a GPU: more environments, and a wider network.

python -m purerl.run suite_gpu --env.task walker-run --num-seeds 5

Expected, of 1000, with three seeds on an H200 and engine `jax`: finger-spin 983 after 20 M steps,
in 98 s, walker-run 840 after 10 M in 70 s; hopper-hop 561 after 50 M. With a discount of their own
acrobot-swingup has 435 after 100 M, in 97 s, walker-run 874 after 60 M in 164 s, and 884 after
100 M; the sparse acrobot 148, with whole episodes too. How each was trained, and others:
lab/2026-11-28-control-suite.md, lab/2026-11-30-six-tasks.md. Humanoids: `suite_humanoid`.
"""

import dataclasses

from purerl.experiments import suite

experiment = dataclasses.replace(
    suite.experiment,
    network=dataclasses.replace(
        suite.experiment.network,
        policy_hidden=(512, 512),  # with 256 an acrobot and a hopper learn less; it takes as long
        value_hidden=(512, 512),
    ),
    ppo=dataclasses.replace(
        suite.experiment.ppo,
        num_steps=50_000_000,
        num_envs=1024,  # with 64, some seeds of humanoid-walk began, and one of humanoid-stand
        rollout_length=32,  # of 128 steps, with 32 minibatches: no humanoid began in 44 M steps
    ),
)
