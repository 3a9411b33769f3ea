"""Adapters: our environments as those of other libraries, and theirs as ours.

May import: core, ppo, physics, report. Read: `stepping.py`, then the file of your library.

  gymnasium_env(env), gymnasium_vector_env(env, number): for `gymnasium`.
  dm_env_environment(env): for `dm_env`.
  from_brax(BraxOptions(name)), from_playground(PlaygroundOptions(name)): their environments for us.
  from_gymnasium(GymnasiumOptions(name)), from_maker(make): Gymnasium's, stepped through the host.

A name is imported when it is first used: each needs its library. docs/howto/adapters.md shows all.
"""

from typing import Any

import purerl

HOMES, _get, __dir__ = purerl.lazy(__name__, __file__)
# Library -> the extra that brings it.
_EXTRAS = {"gymnasium": "gymnasium", "brax": "brax", "mujoco_playground": "playground"}
__all__ = sorted(HOMES)


def __getattr__(name: str) -> Any:
    """Imports an adapter when it is first used."""
    try:
        return _get(name)
    except ModuleNotFoundError as error:
        extra = _EXTRAS.get((error.name or "").partition(".")[0])
        if extra is None:
            raise
        line = purerl.how_to_install(extra)
        raise ImportError(f"adapters.{name} needs {error.name}: {line}") from error
