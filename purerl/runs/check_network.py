"""Checks that a network answers as the trainer expects; nothing is computed."""

import jax
import jax.numpy as jnp

from purerl.core.records import Network, PyTree


def check_network(network: Network, observation: PyTree, action_size: int) -> None:
    """Raises ValueError unless a network's answers have the shapes that the trainer reads.

    Args:
      network: the network; nothing is computed.
      observation: an example, leaves [O].
      action_size: A.
    """
    params, carry = jax.eval_shape(network.init, jax.random.key(0))
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            raise ValueError(
                f"The network's parameter {jax.tree_util.keystr(path)} is {leaf.dtype}: parameters "
                "are trained, so they are floating-point numbers. Keep constants in the closure of "
                "`apply`."
            )
    batch = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct((2, *x.shape), x.dtype), (observation, carry)
    )
    output, following = jax.eval_shape(network.apply, params, *batch)
    scalar, action = (2,), (2, action_size)
    normal = output.distribution
    answers = [("loc", normal.loc, action), ("scale", normal.scale, action)]
    for name, answer, shape in [*answers, ("value", output.value, scalar)]:
        if answer.shape != shape:
            raise ValueError(
                f"The network's {name} is {list(answer.shape)} for 2 observations and "
                f"{action_size} actions; it must be {list(shape)}."
            )
    kinds = [jax.tree.map(lambda x: (x.shape, x.dtype), tree) for tree in (batch[1], following)]
    if kinds[0] != kinds[1]:
        raise ValueError(
            f"The network's memory goes in as {kinds[0]} and comes back as {kinds[1]}, for 2 "
            "environments; `apply` must return it as it was given, and `init` one environment's."
        )
