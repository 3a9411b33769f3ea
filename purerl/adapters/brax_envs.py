"""An environment of brax in our trainer."""

from dataclasses import dataclass
from typing import Literal

from brax import envs

from purerl.adapters.foreign import ForeignEnv, adapt
from purerl.core.errors import unknown_name


@dataclass(frozen=True)
class BraxOptions:
    """Which of brax's environments."""

    name: str = "ant"
    """As brax calls it: ant, humanoid, halfcheetah, ..."""
    backend: Literal["mjx", "generalized", "spring", "positional"] = "mjx"
    """Which of brax's physics."""


def from_brax(options: BraxOptions = BraxOptions(), engine: str = "auto") -> ForeignEnv:  # noqa: B008
    """Builds an environment of brax; `build_env` of an experiment whose `env` is `BraxOptions`.

    Args:
      options: which one.
      engine: not heeded, since brax brings its physics.

    Raises:
      ValueError: brax has none of that name.
    """
    known = sorted(envs._envs)
    if options.name not in known:
        raise ValueError(unknown_name("environment of brax", options.name, known))
    env = envs.get_environment(options.name, backend=options.backend)
    # The other physics of brax simulate other bodies than the model's.
    model = env.sys.mj_model if options.backend == "mjx" else None
    return adapt(env, model, lambda state: state.pipeline_state, float(env.dt))
