r"""A rodent that has learned to move from recordings learns to cross gaps.

python -m purerl.run rodent_gaps_reuse --parts.decoder.run RUN --parts.prior.run RUN

Decoder and prior are those of a run of `rodent_intention`, and stay as they are. What is learned
is where, in a ball around the prior's mean, the code should be: `intention.py` has the network.
`rodent_gaps` is the task from scratch; `--network.no-from-prior --ppo.auxiliary.anchor 0` takes the
decoder alone.
"""

import dataclasses

from purerl import Experiment, Part, networks
from purerl.experiments import intention, rodent_gaps

told = rodent_gaps.experiment
PART = Part(run="rodent_intention", reads=("proprioception",), rate=0.0)
experiment: Experiment = dataclasses.replace(
    told,
    env=dataclasses.replace(told.env, proprioception=True),
    build_network=intention.reuse(networks.mlp),
    network=intention.ReuseOptions(task=told.network),
    ppo=dataclasses.replace(told.ppo, auxiliary={"anchor": 0.1, "code_distance": 0.0}),
    parts={"decoder": PART, "prior": PART},
)
