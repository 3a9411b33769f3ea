r"""dm_control's rodent moves as the clips of a file do, through a code of 16 numbers.

python -m purerl.run rodent_intention
python -m purerl.run rodent_intention --env.clips motion.h5 --env.clip-set train

Expected: 159 clips of this kind, without leaps, were followed to their ends after 18 M steps, 4 min
on an H200 (engine `warp`, one seed), held-out ones too: joints 2 deg off, bodies 5 mm.

`intention.py` has the network. It controls at 50 Hz, as `rodent_gaps_reuse` does: what was learned
at another rate moves the body otherwise.
"""

import dataclasses

from purerl import Evaluation, Experiment
from purerl.experiments import intention, rodent_imitation

imitation = rodent_imitation.experiment
experiment: Experiment = dataclasses.replace(
    imitation,
    env=dataclasses.replace(imitation.env, control_rate=50),
    build_network=intention.imitate,
    network=intention.ImitationOptions(),
    ppo=dataclasses.replace(
        imitation.ppo,
        num_steps=4_000_000,
        num_envs=2048,
        rollout_length=20,
        num_minibatches=16,
        num_epochs=4,
        schedule="linear",
        episode_length=125,  # 2.5 s, all of a clip
        auxiliary={"code_kl": (1e-4, 0.1, 1_000_000), "prior_kl": 1.0},
    ),
    evaluation=Evaluation(num_episodes=128, number=5),
)
