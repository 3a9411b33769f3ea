"""PPO on MuJoCo MJX: readable in an afternoon, reproducible to the last bit.

These names are the whole interface. Whatever else is in this package may move.

Train, and use what was trained:
  train(experiment, settings) -> Run: the same folder, bits and lines as `python -m purerl.run`.
  load(folder) -> Run: a run read back: `policy`, `metrics()`, `evaluate()`, `env`, `state`, ...
  Run, Policy: what these two return, and its `policy(observation) -> action`.

An experiment:
  Experiment: functions that build the environment and the network, and their settings.
  Config, Evaluation: the settings of PPO, and of the evaluations during training.
  find(name) -> Experiment: the experiment of that name, file or module.

An environment:
  Env, State: the protocol, and one environment between two steps.
  check_env, EnvError: checks that an environment keeps to the protocol.
  Physics, PhysicsState: MuJoCo on the engines c, jax and warp.
  choose_engine: which engine "auto" is.
  lookup: a module: MuJoCo's names to indices, actions to controls.
  overflow_reading, overflow_metric: count contacts for which engine warp had no room.

A network:
  Network, PolicyOutput, Normal: a pair of pure functions, and what they return.
  networks: a module: `mlp`, `recurrent`, and `from_linen` for any Flax module.

Other:
  adapters: a package: our environments for Gymnasium and dm_env; brax's and Playground's for us.
  planner: a module: behaviour by search in the simulation, without learning.
  exact: a package: programs of MJX with their sums in a fixed order, without the trainer.
  Array, PyTree: for type annotations.
  UserError, RunError, StoppedError: a wrong call; a run that cannot go on; one that was stopped.

A name is imported when it is first used: `import purerl` does not start JAX.
"""

import difflib
import importlib
import sys
from typing import Any

__version__ = "0.1.0"
# Module -> its public names, as in `__init__.pyi`. A name that is its module's own is a module.
_NAMES = {
    "adapters": "adapters",
    "core.env": "Env EnvError State",
    "core.errors": "RunError StoppedError UserError",
    "core.records": "Array Network Normal PolicyOutput PyTree",
    "exact": "exact",
    "physics.interface": "Physics PhysicsState choose_engine overflow_metric overflow_reading",
    "physics.lookup": "lookup",
    "tune.plan.planner": "planner",
    "ppo.config": "Config Evaluation",
    "ppo.networks": "networks",
    "checks.check_env": "check_env",
    "experiment.definition": "Experiment",
    "experiment.loading": "find",
    "runs.loaded_run": "Run load",
    "runs.policy": "Policy",
    "training.train": "train",
}
HOMES = {name: f"purerl.{home}" for home, names in _NAMES.items() for name in names.split()}
__all__ = sorted(HOMES)


def __getattr__(name: str) -> Any:
    """Imports a public name when it is first used."""
    if name not in HOMES:
        raise AttributeError(f"purerl has no name {name!r}: {_hint(name)}")
    module = importlib.import_module(HOMES[name])
    globals()[name] = getattr(module, name, module)
    return globals()[name]


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


def _hint(name: str) -> str:
    """Returns the line to write instead of a wrong name, or the names that there are."""
    known = {public.lower(): public for public in __all__}
    near = difflib.get_close_matches(name.lower(), known, n=1, cutoff=0.7)
    if near:
        return f"write `from purerl import {known[near[0]]}`."
    return f"the names to import from purerl are {', '.join(__all__)}."


class _Missing:
    """The finder that Python asks last: says what to write instead of a module that is not."""

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> None:
        if name.startswith("purerl."):
            hint = _hint(name.rpartition(".")[2])
            # Another `name` than the module's, or `from purerl import x` would drop the message.
            raise ModuleNotFoundError(f"{name} has moved, or never was: {hint}", name="purerl")


sys.meta_path.append(_Missing)
