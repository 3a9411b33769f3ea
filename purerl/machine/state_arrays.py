"""A state as named arrays on the host, `{path: array}`, and its digest.

A typed key travels as its raw data, and its path ends in `|<implementation>`. In a name, `~`, `/`
and `|` are written as `~0`, `~1` and `~2` (after RFC 6901), so that no two leaves share a path.
"""

import hashlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from purerl.core.records import PyTree, is_key

Leaves = dict[str, np.ndarray]


def leaf_paths(state: PyTree) -> list[str]:
    """Returns the path of every leaf, in the order of `jax.tree.leaves`; abstract states too."""
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return ["/".join(map(_name, at)) + (f"|{_impl(x)}" if is_key(x) else "") for at, x in leaves]


def _name(entry: Any) -> str:
    """Returns one part of a leaf's path."""
    name = jax.tree_util.keystr((entry,), simple=True)
    return name.replace("~", "~0").replace("/", "~1").replace("|", "~2")


def raw(state: PyTree) -> PyTree:
    """Returns a state with its keys as their raw data."""
    return jax.tree.map(lambda x: jax.random.key_data(x) if is_key(x) else x, state)


def flatten(state: PyTree) -> Leaves:
    """Copies a state to the host as `{path: array}`.

    It must copy: on a CPU `device_get` returns views of buffers, which the next update overwrites.
    """
    there = jax.tree.leaves(jax.device_get(raw(state)))
    host = [np.array(x, copy=True, order="C") for x in there]
    return dict(zip(leaf_paths(state), host, strict=True))


def unflatten(leaves: Leaves, abstract: PyTree) -> PyTree:
    """Rebuilds a state on the device from `flatten`'s arrays (zero-size ones may be absent)."""
    out = []
    for path, like in zip(leaf_paths(abstract), jax.tree.leaves(abstract), strict=True):
        if is_key(like) and not like.size:
            raise ValueError(f"A zero-size array of keys (shape {like.shape}) cannot be rebuilt.")
        # A real copy again: a buffer shared with numpy must not be donated.
        stored = leaves[path] if like.size else np.zeros(like.shape, like.dtype)
        array = jnp.array(stored, copy=True)
        out.append(jax.random.wrap_key_data(array, impl=_impl(like)) if is_key(like) else array)
    return jax.tree.unflatten(jax.tree.structure(abstract), out)


def digest_leaves(leaves: Leaves) -> str:
    """Returns a sha256 over path, dtype, shape and bytes of every leaf, in path order.

    Two runs whose states have equal digests are the same run.
    """
    total = hashlib.sha256()
    for path, array in sorted(leaves.items()):
        total.update(f"{path}\0{array.dtype}\0{array.shape}\0".encode())
        total.update(array.tobytes())
    return total.hexdigest()


def _impl(key: Any) -> str:
    """Returns the name of a key's implementation; of abstract keys too, which key_impl refuses."""
    return str(jax.random.key_impl(jnp.empty((0,), key.dtype)))
