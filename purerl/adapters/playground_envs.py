"""An environment of MuJoCo Playground in our trainer."""

import subprocess
from dataclasses import dataclass
from typing import Literal

from mujoco_playground import registry

from purerl.adapters.foreign import ForeignEnv, adapt
from purerl.core.errors import one_line, unknown_name


@dataclass(frozen=True)
class PlaygroundOptions:
    """Which of Playground's environments."""

    name: str = "CartpoleSwingup"
    """As Playground calls it: CartpoleSwingup, CheetahRun, Go1JoystickFlatTerrain, ..."""
    impl: Literal["jax", "warp"] = "jax"
    """Which implementation of MJX."""


def from_playground(
    options: PlaygroundOptions = PlaygroundOptions(),  # noqa: B008
    engine: str = "auto",
) -> ForeignEnv:
    """Builds an environment; `build_env` of an experiment whose `env` is `PlaygroundOptions`.

    Args:
      options: which one.
      engine: not heeded, since Playground brings its physics.

    Raises:
      ValueError: Playground has none of that name, or cannot download its model.
    """
    if options.name not in registry.ALL_ENVS:
        known = registry.ALL_ENVS
        raise ValueError(unknown_name("environment of Playground", options.name, known))
    config = registry.get_default_config(options.name)
    overrides = {"impl": options.impl} if "impl" in config else {}
    try:
        env = registry.load(options.name, config=config, config_overrides=overrides)
    except (OSError, subprocess.SubprocessError) as error:
        raise ValueError(f"Playground's robots need a network, once: {one_line(error)}") from error
    return adapt(env, env.mj_model, lambda state: state.data, float(env.dt))
