r"""An ant that has learned to move from recordings learns to cross gaps.

python -m purerl.run ant_gaps_reuse --parts.decoder.run RUN --parts.prior.run RUN

RUN is one of `ant_intention`. Expected: 10 to 12 gaps after 0.1 M steps, in the first minute, where
`ant_gaps` has 2 to 3; 15 to 16 of 19 after 1.5 M, where that has 17 to 18. Three seeds, a CPU core
each. `rodent_gaps_reuse` is the same of a rodent, and tells of the network.
"""

import dataclasses

from purerl import Experiment, Part, networks
from purerl.experiments import ant_gaps, ant_intention, intention

told, moves = ant_gaps.experiment, ant_intention.experiment.network
PART = Part(run="ant_intention", reads=("proprioception",), rate=0.0)
experiment: Experiment = dataclasses.replace(
    told,
    env=dataclasses.replace(told.env, proprioception=True),
    build_network=intention.reuse(networks.mlp),
    network=intention.ReuseOptions(
        code=moves.code,
        decoder=moves.decoder,
        prior=moves.prior,
        initial_std=moves.initial_std,
        radius=4.0,  # 95% of codes of 8 numbers that are drawn from the prior are nearer than 3.94
        task=told.network,
    ),
    ppo=dataclasses.replace(
        told.ppo, num_steps=1_500_000, auxiliary={"anchor": 0.1, "code_distance": 0.0}
    ),
    parts={"decoder": PART, "prior": PART},
)
