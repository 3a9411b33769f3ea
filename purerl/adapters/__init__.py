"""Adapters: our environments as those of other libraries, and theirs as ours.

May import: core, ppo, physics. Read: `stepping.py`, then the file of the library that you want.

  gymnasium_env(env), gymnasium_vector_env(env, number): for `gymnasium`.
  dm_env_environment(env): for `dm_env`.
  from_brax(name), from_playground(name): environments of brax and MuJoCo Playground, for us.

A name is imported when it is first used: each needs its library. docs/adapters.md shows all.
"""

import importlib
from typing import Any

HOMES = {
    "gymnasium_env": "to_gymnasium",
    "gymnasium_vector_env": "to_gymnasium",
    "dm_env_environment": "to_dm_env",
    "from_brax": "brax_envs",
    "from_playground": "playground_envs",
}
# What a library's absence is answered with.
_INSTALL = {
    "gymnasium": "gymnasium",
    "dm_env": "dm-env",
    "brax": "brax",
    "mujoco_playground": "playground",
}
__all__ = sorted(HOMES)


def __getattr__(name: str) -> Any:
    """Imports an adapter when it is first used."""
    if name not in HOMES:
        raise AttributeError(f"purerl.adapters has no {name!r}; it has {', '.join(__all__)}.")
    try:
        return getattr(importlib.import_module(f"{__name__}.{HOMES[name]}"), name)
    except ModuleNotFoundError as error:
        package = _INSTALL.get((error.name or "").partition(".")[0])
        if package is None:
            raise
        raise ImportError(
            f"adapters.{name} needs {package}: python -m pip install -c constraints.txt {package}"
        ) from error


def __dir__() -> list[str]:
    return __all__
