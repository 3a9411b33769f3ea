"""What a run has learned, as a function from numpy to numpy."""

import math
import operator
from typing import Any

import jax
import numpy as np

from purerl.core.env import Env
from purerl.core.errors import UserError
from purerl.core.records import Array, Network, PyTree, TrainState
from purerl.ppo import distributions, running_moments
from purerl.ppo.episodes import draw, start_memory


class Policy:
    """A policy in use: `policy(observation) -> action`.

    A recurrent policy carries its memory from call to call: `reset` it before each episode.

    >>> policy = load(folder).policy
    >>> policy.reset()
    >>> policy(np.zeros((3, 5))).shape  # of 3 environments
    (3, 1)
    """

    def __init__(self, env: Env, network: Network, state: TrainState, run: object = None) -> None:
        """Prepares a policy at the start of an episode.

        Args:
          env: for the shapes of an observation.
          network: the network.
          state: for `params` and `normalizer`, and the shape of one environment's memory.
          run: the `Run` that it is of; None: of none.
        """

        def act(state: TrainState, observation: PyTree, memory: PyTree, key: Any) -> Any:
            observation = running_moments.normalize(state.normalizer, observation)
            ids = jax.numpy.arange(len(jax.tree.leaves(observation)[0]))
            drawn = () if key is None else draw(network, key, ids)
            output, memory = network.apply(state.params, observation, memory, *drawn)
            raw = output.distribution.loc
            if key is not None:
                raw = distributions.sample(output.distribution, jax.random.normal(key, raw.shape))
            return distributions.to_action(raw), memory

        self._example = jax.eval_shape(env.reset, jax.random.key(0)).observation
        self._state, self._act, self._run = state, jax.jit(act), run
        self.reset()

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles as the run's folder and what is remembered: who unpickles it reads the run."""
        if self._run is None:
            raise UserError("A policy of no run cannot be pickled: pickle its parameters.")
        remembered = {"_memory": self._memory, "_batch": self._batch}
        return operator.attrgetter("policy"), (self._run,), remembered

    def reset(self) -> None:
        """Forgets: the next observation begins an episode."""
        self._memory: PyTree = None
        self._batch: tuple[int, ...] = ()

    @property
    def memory(self) -> PyTree:
        """What a recurrent policy remembers after the last call, [..., H]; None before the first.

        The leading axes are those of the observation.
        """
        batch = self._batch
        return jax.tree.map(lambda x: np.asarray(x).reshape(*batch, *x.shape[1:]), self._memory)

    def __call__(self, observation: PyTree, key: Array | None = None) -> np.ndarray:
        """Chooses an action, and moves the memory on.

        Args:
          observation: as the environment gives it, an array [..., O] or a dict of them: of one
            environment, or of several with leading axes.
          key: None for the distribution's centre; a typed key [] to sample.

        Returns:
          Actions [..., A] in [-1, 1], float32.

        Raises:
          UserError: the observation has another shape, or another number of environments than
            the memory, or is traced.
        """
        batch, flat = _flatten(observation, self._example)
        if self._memory is None:
            self._memory, self._batch = start_memory(self._state.memory, math.prod(batch)), batch
        elif batch != self._batch and jax.tree.leaves(self._memory):
            raise UserError(
                f"The policy remembers environments {list(self._batch)}, and the observation is "
                f"of {list(batch)}: call reset() before an episode."
            )
        action, self._memory = self._act(self._state, flat, self._memory, key)
        return np.asarray(action).reshape(*batch, action.shape[-1])


def _flatten(observation: Any, example: PyTree) -> tuple[tuple[int, ...], PyTree]:
    """Returns the leading axes of leaves [..., O], and the leaves as [B, O]; `example` has [O]."""
    if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(observation)):
        raise UserError(
            "The observation is traced, by jax.jit, vmap or scan, and a policy takes numbers: it "
            "keeps its memory from call to call. Compile env.step alone, and call the policy "
            "between steps; docs/howto/own_loop.md has whole episodes compiled."
        )
    try:
        arrays = jax.tree.map(lambda one, x: np.asarray(x, one.dtype), example, observation)
    except (TypeError, ValueError):
        arrays = None
    pairs = list(zip(jax.tree.leaves(arrays), jax.tree.leaves(example), strict=False))
    batches = {x.shape[: max(x.ndim - one.ndim, 0)] for x, one in pairs}
    if len(batches) != 1 or any(x.shape[-one.ndim :] != one.shape for x, one in pairs):
        given = jax.tree.map(np.shape, observation, is_leaf=lambda x: isinstance(x, list))
        raise UserError(
            f"The observation's shape is {given}; it must be {jax.tree.map(np.shape, example)}, "
            "with the same leading axes everywhere for several environments."
        )
    return batches.pop(), jax.tree.map(lambda x, one: x.reshape(-1, *one.shape), arrays, example)
