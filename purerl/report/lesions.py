"""Lesions: units of a policy that are silent, noisy or held while it acts.

They are made inside the network's forward pass, so that all that is computed from a layer is
computed from what the lesion left of it.
"""

from collections.abc import Mapping
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from purerl.core.errors import UserError, unknown_name
from purerl.core.keys import Purpose, derive
from purerl.core.records import Array, Network, PyTree, TrainState
from purerl.experiment.objects import Setup
from purerl.experiment.options import Lesion
from purerl.ppo import episodes, evaluation
from purerl.report.episode_arrays import note_modules

PRIME = 7  # episodes of a trial call: what is not of a multiple of them has no row for each


def lesioned(
    setup: Setup, state: TrainState, lesion: Lesion, seed: int, layers: Mapping[str, int] = {}
) -> tuple[Setup, TrainState, int]:
    """Returns objects and a state with which a policy acts with a lesion.

    The lesion, but for its layers and its kind, is data: it is in the state's `params`, so that a
    program that is compiled once computes all of them; its `memory` counts an episode's steps.

    Args:
      setup: the objects without it.
      state: the state without it.
      lesion: which; without a layer, both come back as they are.
      seed: draws the units of a share, and noise.
      layers: what `units_of` returned, if that has been asked.

    Returns:
      Both, and how many units it hits.

    Raises:
      UserError: there is no such layer, or it has no such unit, or all but the layer is given.
    """
    if not lesion.layer:
        if lesion != Lesion():
            raise UserError("The lesion has no layer: add --lesion.layer policy/Dense_0.")
        return setup, state, 0
    hit = choose_units(layers or units_of(setup, state), lesion, seed)
    last = np.iinfo(np.int32).max if lesion.end is None else lesion.end
    dose = {
        "hit": hit,  # layer -> [U] bool
        "strength": np.float32(lesion.strength),
        "during": np.array([lesion.begin, last], np.int32),  # the first step, and the first after
        "key": derive(jax.random.key(seed), Purpose.NETWORK),
    }
    memory = state.memory, jnp.zeros((1, 1), jnp.int32)
    state = state.replace(params=(state.params, dose), memory=memory)
    network = setup.network._replace(apply=lesioned_apply(setup.network, lesion.kind))
    return setup._replace(network=network), state, sum(int(x.sum()) for x in hit.values())


def units_of(setup: Setup, state: TrainState) -> dict[str, int]:
    """Returns how many units each layer has, by the names of `record`; {} for networks of no Flax.

    A layer's units are its last axis: of a picture's features, the channels.
    """
    noted: dict[str, Array] = {}

    def ask(state: TrainState, key: Array) -> None:
        begun = evaluation.start(setup.env, state, key, PRIME, 1)
        with nn.intercept_methods(note_modules(noted)):
            episodes.act(setup.network, state, begun.env_state, begun.memory)

    jax.eval_shape(ask, state, jax.random.key(0))
    return {n: x.shape[-1] for n, x in noted.items() if x.ndim > 1 and x.shape[0] % PRIME == 0}


def choose_units(layers: Mapping[str, int], lesion: Lesion, seed: int) -> dict[str, np.ndarray]:
    """Returns which units of each layer a lesion hits, [U] bool; arguments as of `lesioned`."""
    hit = {}
    for number, name in enumerate(lesion.layer):
        if name not in layers:
            raise UserError(unknown_name("layer", name, layers))
        ends = f"0-{layers[name] - 1}" if lesion.units == "all" else lesion.units
        pairs = [[int(x) for x in part.split("-")] for part in ends.split(",")]
        units = sorted({i for pair in pairs for i in range(pair[0], pair[-1] + 1)})
        if not units or units[-1] >= layers[name]:
            have = f"there are 0 to {layers[name] - 1} of {name}"
            raise UserError(f"units is {lesion.units!r}; {have}, and some are needed.")
        drawn = np.random.default_rng((seed, number)).permutation(units)
        hit[name] = np.isin(np.arange(layers[name]), drawn[: round(lesion.share * len(units))])
    return hit


def lesioned_apply(network: Network, kind: str) -> Any:
    """Returns `apply` of a network that acts with a lesion, for states of `lesioned`."""

    def apply(params: PyTree, seen: PyTree, memory: PyTree, *noise: PyTree) -> tuple[Any, PyTree]:
        (params, dose), (memory, step) = params, memory  # step: [N, 1]
        begin, end = dose["during"]

        def change(name: str, x: Array) -> Array:
            if name not in dose["hit"]:
                return x
            rows = x.reshape(len(step), -1, x.shape[-1])  # [N, K, U]
            key = jax.random.fold_in(dose["key"], list(dose["hit"]).index(name))
            hurt = changed(kind, rows, dose["strength"], key, step[:, 0])
            now = ((begin <= step) & (step < end))[:, None] & dose["hit"][name]
            return jnp.where(now, hurt, rows).reshape(x.shape)

        with nn.intercept_methods(note_modules({}, change)):
            output, memory = network.apply(params, seen, memory, *noise)
        return output, (memory, step + 1)

    return apply


def changed(kind: str, x: Array, strength: Array, key: Array, step: Array) -> Array:
    """Returns a layer's activity as a lesion of all its units makes it, [N, K, U].

    Args:
      kind: as `Lesion` has it, and `strength` [].
      x: [N, K, U] the activity.
      strength: [].
      key: [] typed, the layer's.
      step: [N] of each episode.
    """
    if kind == "silence":
        return (1.0 - strength) * x
    if kind == "clamp":
        return jnp.full_like(x, strength)
    fold = jax.random.fold_in
    keys = jax.vmap(lambda t, i: fold(fold(key, t), i))(step, jnp.arange(len(x)))
    return x + strength * jax.vmap(lambda key: jax.random.normal(key, x.shape[1:]))(keys)
