"""What every format of an exported policy shares: the policy as a function, a check of its actions.

`jax` and `onnx` files are made of the function.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from purerl.core.records import Array, PyTree
from purerl.ppo import distributions, episodes, running_moments
from purerl.report import episode_arrays, flat_program
from purerl.runs.loaded_run import Run

EPISODES = 8  # that an exported policy is compared on


class Recorded(NamedTuple):
    """Whole episodes of a run's own policy, as `python -m purerl.record` has them."""

    observation: PyTree  # [N, T, O], or a dict of such
    action: np.ndarray  # [N, T, A]
    length: np.ndarray  # [N] steps; what comes after them is no part of an episode

    def compare(self, policy: Callable[[Any], np.ndarray]) -> str:
        """Returns the line that tells how near another policy comes to these actions."""
        return (
            f"Largest difference from the run's own actions: {self.difference(policy):.1e}, over "
            f"{self.length.sum():,} observations of {len(self.length)} episodes."
        )

    def difference(self, policy: Callable[[Any], np.ndarray]) -> float:
        """Returns the largest absolute difference of `policy` over all steps of all episodes.

        Args:
          policy: float32 observations of N environments, leaves [N, O], to actions [N, A]; called
            once a step, from the beginning of N episodes.
        """
        largest = 0.0
        for t in range(self.action.shape[1]):
            action = policy(jax.tree.map(lambda x, t=t: x[:, t], self.observation))
            gap = np.abs(np.asarray(action, float) - self.action[:, t])[t < self.length]
            # NaN is no small difference.
            largest = max(largest, float(np.nan_to_num(gap, nan=np.inf).max(initial=0.0)))
        return largest


def record_episodes(run: Run, seed: int) -> Recorded:
    """Plays whole episodes of a run's policy."""
    arrays = episode_arrays.record(run.restored.setup, run.state, seed, EPISODES)
    prefix = "observation/"
    parts = {k.removeprefix(prefix): x for k, x in arrays.items() if k.startswith(prefix)}
    return Recorded(parts or arrays["observation"], arrays["action"], arrays["length"])


def control_range(run: Run) -> np.ndarray | None:
    """Returns what actions -1 and 1 are for each actuator, [A, 2], as `lookup.scale_action` does.

    None where the environment has no model of as many limited actuators as actions.
    """
    model = getattr(getattr(run.env, "physics", None), "model", None)
    if model is None or model.nu != run.env.action_size or not model.actuator_ctrllimited.all():
        return None
    return np.asarray(model.actuator_ctrlrange, np.float32)


def origin(run: Run) -> dict[str, Any]:
    """Returns which policy it is: of what experiment, after how many steps, of what digest."""
    name = run.restored.source.name
    return {"experiment": name, "update": run.update, "steps": run.steps, "digest": run.digest}


# --- the policy as a function ---


class PolicyFunction(NamedTuple):
    """A function of batches, and examples of one environment's arguments."""

    act: Callable[[PyTree, PyTree], tuple[Array, PyTree]]  # see `policy_function`
    observation: PyTree  # leaves [O]
    memory: PyTree  # leaves [H], as an episode starts: zeros


def policy_function(run: Run) -> PolicyFunction:
    """Returns `act(observation, memory) -> (action, memory)` with leading axes [N, ...].

    Normalization and tanh are inside. Of an observation that is a dict, `act` takes only the
    entries that the action or the memory depends on: those for the value function are left out.
    """
    network, state = run.network, run.state
    shapes = jax.eval_shape(run.env.reset, jax.random.key(0)).observation
    everything = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    memory = jax.tree.map(lambda x: x[0], episodes.start_memory(state.memory, 1))

    def act(observation: PyTree, memory: PyTree) -> tuple[Array, PyTree]:
        seen = running_moments.normalize(state.normalizer, observation)
        output, memory = network.apply(state.params, seen, memory)
        return distributions.to_action(output.distribution.loc), memory

    if not isinstance(everything, dict):
        return PolicyFunction(act, everything, memory)
    read = flat_program.flat_program(act, everything, memory).read
    names = [name for number, name in enumerate(sorted(everything)) if number in read]
    needed = {name: everything[name] for name in names}

    def act_on(observation: dict[str, Any], memory: PyTree) -> tuple[Array, PyTree]:
        number = next(iter(observation.values())).shape[0]
        absent = {k: jnp.zeros((number, *x.shape), x.dtype) for k, x in everything.items()}
        return act(absent | observation, memory)

    return PolicyFunction(act_on, needed, memory)


def remembering(
    policy: PolicyFunction, call: Callable[[PyTree, PyTree], tuple[Any, PyTree]]
) -> Callable[[Any], np.ndarray]:
    """Returns a function of the whole observation that carries the memory from call to call."""
    memory: PyTree = None

    def act(observation: Any) -> np.ndarray:
        nonlocal memory
        if isinstance(policy.observation, dict):
            observation = {name: observation[name] for name in policy.observation}
        if memory is None:
            number = jax.tree.leaves(observation)[0].shape[0]
            memory = jax.tree.map(lambda x: np.zeros((number, *x.shape), x.dtype), policy.memory)
        action, memory = call(observation, memory)
        return np.asarray(action)

    return act
