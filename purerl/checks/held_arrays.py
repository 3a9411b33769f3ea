"""Hashes of the arrays and numbers that an environment and a network hold, wherever they are from.

A reference motion that a file was read for, a network that another run trained: programs have them
as constants, so a trace shows all of them, and no list has to be kept.
"""

import hashlib
from collections import defaultdict

import jax
import jax.numpy as jnp
import numpy as np

from purerl.core.env import Env
from purerl.core.records import Array, Network, PyTree
from purerl.exact.traces import constants
from purerl.machine.state_arrays import raw
from purerl.physics.without_engine import without_engine


def hash_held(env: Env, network: Network) -> dict[str, str]:
    """Returns a short sha256 of all constants of each dtype and shape, as "float32[3, 4]".

    They are those of the four functions, and not of the engine's: the model has a hash of its own.
    So they are the same on every engine and device.
    """
    env = without_engine(env)

    def call_all(key: Array, action: Array) -> PyTree:
        one, other, third = jax.random.split(key, 3)
        state, (params, memory) = env.step(env.reset(one), action), network.init(other)
        given = (state.observation, memory) + ((network.draw(third),) if network.draw else ())
        batch = jax.tree.map(lambda x: x[None], given)
        return state, network.apply(params, *batch)

    traced = jax.make_jaxpr(call_all)(jax.random.key(0), jnp.zeros(env.action_size, jnp.float32))
    held = {id(x): x for x in constants(traced)}  # each array once
    found = defaultdict(list)
    for x in map(np.asarray, raw(list(held.values()))):
        found[f"{x.dtype}{list(x.shape)}"].append(hashlib.sha256(x.tobytes()).hexdigest())
    parts = {name: "".join(hashes).encode() for name, hashes in sorted(found.items())}
    return {name: hashlib.sha256(part).hexdigest()[:16] for name, part in parts.items()}
