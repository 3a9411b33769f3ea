"""Checks of a network on real observations: is it finite, and does it use what it is given?"""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from purerl.checks.findings import Finding, error, ok, warning
from purerl.core.errors import some
from purerl.core.records import Array, Network, PyTree
from purerl.machine.state_arrays import flatten

STEP = 0.01  # std of what is added to parameters, for a look at the network after a first step


def examine(network: Network, observation: PyTree) -> Iterator[Finding]:
    """Yields what is found of a network.

    Args:
      network: the network.
      observation: leaves [N, O], as the environment returns them.
    """
    params, carry = network.init(jax.random.key(0))
    inputs = jax.tree.map(_normalize, observation)
    number = jax.tree.leaves(inputs)[0].shape[0]
    memory = jax.tree.map(lambda x: jnp.zeros((number, *x.shape), x.dtype), carry)
    probe = jax.jit(_probe, static_argnums=0)
    answers, gradients = probe(network, params, inputs, memory)
    (_, following), moved = probe(network, _moved(params), inputs, memory)
    _, scale, value, *_ = answers[0]
    broken = [n for n, x in zip(("loc", "scale", "value"), answers[0], strict=False) if _bad(x)]
    if broken:
        verb = "is" if len(broken) == 1 else "are"
        what = f"{some(broken)} {verb} not finite for observations of mean 0, std 1."
        yield error("outputs", what)
        return
    if not (np.asarray(scale) > 0).all():
        yield error("outputs", "scale is not above 0 everywhere: take softplus or exp of it.")
        return
    yield ok("outputs", f"value {np.min(value):.2g} to {np.max(value):.2g}, finite")
    yield from _check_batch(network, _moved(params), inputs, memory)
    yield from _check_memory(memory, following)
    yield from _check_inputs(*moved[:2])
    rates = network.scale(jax.tree.map(jnp.ones_like, params))
    yield _check_parameters(gradients[2], moved[2], rates)


def _moved(params: PyTree) -> PyTree:
    """Returns parameters as a first step of training might leave them.

    A layer that begins with zeros, as the last of a residual block often does, hides all before it
    until then.
    """
    noise = optax.tree.random_like(jax.random.key(0), params)
    return jax.tree.map(lambda x, step: x + STEP * step, params, noise)


def _check_batch(network: Network, *given: PyTree) -> Iterator[Finding]:
    """Is the answer to an observation that to it alone? `given`: parameters, inputs, memory."""

    def first(params: PyTree, *batch: PyTree) -> np.ndarray:
        output, _ = jax.jit(network.apply)(params, *batch)
        return np.hstack([np.ravel(x[0]) for x in (*output.distribution, output.value)])

    whole, alone = first(*given), first(given[0], *jax.tree.map(lambda x: x[:1], given[1:]))
    if (apart := np.abs(whole - alone).max()) > 1e-3 * (1.0 + np.abs(alone).max()):
        yield error("batch", f"alone an observation has another answer than among others, by "
                    f"{apart:.2g}: compute each row of a batch by itself.")  # fmt: skip


def _normalize(x: Array) -> Array:
    x = jnp.nan_to_num(x)
    return (x - x.mean(0)) / (x.std(0) + 1e-6)


def _bad(x: Any) -> bool:
    return not np.isfinite(np.asarray(x)).all()


def _probe(network: Network, params: PyTree, inputs: PyTree, memory: PyTree) -> tuple[Any, Any]:
    """Returns answers, and how value and policy change with inputs, and both with parameters.

    The network is applied twice, since parameters that read a memory do nothing at its zeros.
    """

    def twice(params: PyTree, inputs: PyTree) -> tuple[Any, PyTree]:
        _, between = network.apply(params, inputs, memory)
        output, following = network.apply(params, inputs, between)
        return (*output.distribution, output.value, *output.losses.values()), following

    def weighted(params: PyTree, inputs: PyTree, which: tuple[int, ...]) -> Array:
        found = twice(params, inputs)[0]
        weights = [1.0 + jax.random.uniform(jax.random.key(i), found[i].shape) for i in which]
        parts = [jnp.vdot(w, found[i]) for w, i in zip(weights, which, strict=True)]
        return jnp.sum(jnp.stack(parts))

    by_inputs = jax.grad(weighted, argnums=1)
    of_value, of_policy = (by_inputs(params, inputs, which) for which in ((2,), (0, 1)))
    found = twice(params, inputs)
    of_parameters = jax.grad(weighted)(params, inputs, tuple(range(len(found[0]))))
    return found, (of_value, of_policy, of_parameters)


def trained(params: PyTree) -> PyTree:
    """Returns what is trained: of Flax's variables `params` alone (`networks.from_linen`)."""
    is_flax = isinstance(params, dict) and "params" in params
    return {"params": params["params"]} if is_flax else params


def _check_memory(before: PyTree, after: PyTree) -> Iterator[Finding]:
    leaves = list(zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True))
    if leaves and all((np.asarray(a) == b).all() for a, b in leaves):
        yield warning("memory", "it never changes: return the new memory from `apply`.")


def _check_inputs(of_value: PyTree, of_policy: PyTree) -> Iterator[Finding]:
    """Warns of inputs that are not read, or read by the policy, which will not have them."""
    reads = {
        name: [k for k, x in flatten(tree).items() if np.asarray(x).any()]
        for name, tree in (("value", of_value), ("policy", of_policy))
    }
    entries = list(flatten(of_value))
    blind = [k for k in entries if k not in reads["value"]]
    if blind:
        yield warning("inputs", f"the value does not depend on {_observations(blind)}.")
    own = [k for k in entries if k in ("", "policy")]
    if own and own[0] not in reads["policy"]:
        yield warning("inputs", f"the policy does not depend on {_observations(own)}.")
    # What has more axes than features have is a picture, which the policy's own eyes may see.
    flat = [k for k, x in flatten(of_policy).items() if x.ndim < 3]
    secret = [k for k in reads["policy"] if k in flat and k not in ("", "policy")]
    if "policy" in entries and secret:
        yield warning("inputs", f"the policy reads {_observations(secret)}: only `policy` is its.")
    if not blind and not secret:
        yield ok("inputs", "policy and value depend on the observation")


def _observations(names: list[str]) -> str:
    return some([f"observation[{name!r}]" if name else "the observation" for name in names])


def _check_parameters(gradients: PyTree, moved: PyTree, rates: PyTree) -> Finding:
    """Tells which gradients are not finite at first, and which are zero after a step too.

    Those of rate 0 shall be: they are frozen.
    """
    found, later, rates = (flatten(trained(tree)) for tree in (gradients, moved, rates))
    broken = [name for name, x in found.items() if _bad(x)]
    if broken:
        return error("gradients", f"of {some(broken)} are not finite.")
    idle = [name for name, x in later.items() if not x.any() and rates[name].any()]
    if idle:
        what = "has none: it is" if len(idle) == 1 else "have none: they are"
        return warning("gradients", f"{some(idle)} {what} never trained.")
    return ok("gradients", f"each of {len(found)} parameters has one")
