"""Parts of a network: how fast each learns, and in whose units it reads the observation.

A part is a subtree of the parameters, in any collection, by its name: "decoder", or "eyes/left".
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax

from purerl.core.errors import unknown_name
from purerl.core.records import Network, PolicyOutput, PyTree
from purerl.experiment.definition import Part
from purerl.machine.state_arrays import leaf_paths


def map_named(function: Callable[..., Any], tree: PyTree, *more: PyTree) -> PyTree:
    """Returns `function(path, leaf, ...)` of each leaf, and of those of trees that are like it."""
    paths = iter(leaf_paths(tree))
    return jax.tree.map(lambda *leaves: function(next(paths), *leaves), tree, *more)


def belongs(path: str, name: str) -> bool:
    """Tells whether a leaf of that path is in the subtree of a name."""
    return f"/{name}/" in f"/{path}/"


def is_held(path: str, entries: tuple[str, ...] | None) -> bool:
    """Tells whether a leaf of the statistics of observations is one of those entries'."""
    alone = path.count("/") == 1  # "mean/value": the observation is an array
    return path[:5] != "count" and any(alone or belongs(path, entry) for entry in entries or ())


def top_names(paths: list[str]) -> list[str]:
    """Returns the names of the largest parts, from the paths of all parameters."""
    return sorted({path.removeprefix("params/").partition("/")[0] for path in paths})


def with_parts(
    network: Network, parts: Mapping[str, Part], params: PyTree, observation: PyTree
) -> Network:
    """Returns the network with its parts frozen, or learning, as they are set.

    Args:
      network: the network.
      parts: name -> settings.
      params: its parameters, of which shapes suffice.
      observation: of one environment, likewise.

    Raises:
      ValueError: there is no such part, or no such entry of the observation.
    """
    if not parts:
        return network
    paths = leaf_paths(params)
    entries = sorted(observation) if isinstance(observation, dict) else ["policy"]
    for name, part in parts.items():
        if not any(belongs(path, name) for path in paths):
            raise ValueError(unknown_name("part of the network", name, top_names(paths)))
        for entry in part.reads or ():
            if entry not in entries:
                raise ValueError(unknown_name("entry of the observation", entry, entries))

    def rate(path: str) -> float:
        return next((part.rate for name, part in parts.items() if belongs(path, name)), 1.0)

    # No gradient: Adam's moments stay 0, and the norm by which gradients are clipped is the rest's.
    def apply(params: PyTree, *given: PyTree, **more: Any) -> tuple[PolicyOutput, PyTree]:
        stop = jax.lax.stop_gradient
        moving = map_named(lambda path, x: x if rate(path) else stop(x), params)
        return network.apply(moving, *given, **more)

    vars(apply)["sequences"] = getattr(network.apply, "sequences", False)
    held = tuple(entry for part in parts.values() for entry in part.reads or ())
    scale = partial(map_named, lambda path, x: rate(path) * x)
    hold = partial(map_named, lambda path, old, new: old if is_held(path, held) else new)
    return network._replace(apply=apply, scale=scale, hold=hold)
