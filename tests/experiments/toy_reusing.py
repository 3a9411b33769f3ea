"""Follow a cue by the code of a run of `toy_imitating.py`, with a memory."""

from dataclasses import replace

from purerl import networks
from purerl.experiment.definition import Part
from purerl.experiments import intention
from tests.experiments.toy_imitating import SMALL, Feeling
from tests.runs import toy_experiment

PART = Part(rate=0.0, run="nowhere", reads=("proprioception",))


def build_env(options: toy_experiment.EnvOptions, engine: str) -> Feeling:
    return Feeling(toy_experiment.build_env(options, engine), "policy", size=2.0)


experiment = replace(
    toy_experiment.experiment,
    build_env=build_env,
    build_network=intention.reuse(networks.recurrent),
    network=intention.ReuseOptions(
        **SMALL, task=networks.RecurrentOptions(hidden=6, encoder=(8,), value_hidden=(8,))
    ),
    ppo=replace(toy_experiment.experiment.ppo, auxiliary={"anchor": 0.1, "code_distance": 0.0}),
    parts={"decoder": PART, "prior": PART},
)
