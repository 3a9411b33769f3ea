"""An environment without its engine, to trace at once what else it reads and computes."""

import copy
from typing import Any

import jax
import jax.numpy as jnp

from purerl.core.env import Env
from purerl.core.records import Array, PyTree
from purerl.physics import interface, lookup


class NoEngine:
    """In the place of an engine: results of the right shapes, which follow from all it is given."""

    def __init__(self, physics: interface.Physics) -> None:
        """Asks MuJoCo for the readings' shapes."""
        self.record = physics._engine.record
        self.shapes = lookup.reading_shapes(physics.model, self.record._fields).values()

    def init(self, state: PyTree, changes: dict[str, Array], ctrl: Array | None = None) -> tuple:
        """Returns readings."""
        return self.step(state, jnp.zeros(()) if ctrl is None else ctrl, changes)[1]

    def step(self, state: PyTree, ctrl: Array, changes: dict[str, Array]) -> tuple[PyTree, tuple]:
        """Returns a state and readings."""
        given = sum(jnp.sum(x) for x in jax.tree.leaves((state, ctrl, changes)))
        readings = (jnp.full(shape, given, jnp.float32) for shape in self.shapes)
        return jax.tree.map(lambda x: x + given, state), self.record(*readings)


def without_engine(env: Env) -> Env:
    """Returns a copy of an environment whose `physics` computes nothing; itself if it has none.

    A copy, since JAX keeps what it has traced of an object, for the next who asks. Physics that the
    environment holds under another name, or as a property, computes as ever.
    """
    held: Any = getattr(env, "__dict__", {})
    if not isinstance(held.get("physics"), interface.Physics):
        return env
    found: Any = copy.copy(env)
    found.__dict__["physics"] = still = copy.copy(held["physics"])
    still._engine = NoEngine(still)
    return found
