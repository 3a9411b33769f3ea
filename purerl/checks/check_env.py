"""Checks that an environment keeps to the protocol of `purerl.core.env`."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from purerl.checks.check_traces import check_traces
from purerl.checks.user_code import check_takes, in_words, own_line
from purerl.core.env import ABSURD, Env, EnvError, State
from purerl.core.errors import UserError
from purerl.core.records import Array, PyTree, is_key
from purerl.machine.state_arrays import flatten
from purerl.physics import reasons

# What an evaluation measures itself, and adds of the return.
RESERVED = {"episode_return", "episode_length", "lost"}
RESERVED |= {f"episode_return_{name}" for name in ("std", "min", "max")}


def check_env(env: Env, num_envs: int = 16, num_steps: int = 4) -> None:
    """Verifies that an environment keeps to the protocol, by using it as the trainer does.

    Args:
      env: the environment.
      num_envs: B, environments stepped together, at least 2; of few, all may start alike by chance.
      num_steps: T, steps with random actions, after one each with all -1, 0 and 1.

    Raises:
      EnvError: names the field that broke a rule, and the rule.
    """
    check_shapes(env)
    trial = try_out(env, num_envs, num_steps)
    check_repeats(env, trial)
    check_differs(trial.start)
    check_finite("reset", trial.start)
    check_finite("step", trial.states)
    ended = trial.last.replace(terminated=jnp.ones(num_envs, bool))
    check_finite("a step after termination", trial.rollout(ended, trial.actions)[1])


class Trial(NamedTuple):
    """What B environments did in T steps."""

    start: State  # [B, ...]
    restart: State  # [B, ...] of the same keys
    actions: Array  # [T, B, A]
    last: State  # [B, ...]
    states: State  # [T, B, ...] after each step
    rollout: Callable[[State, Array], tuple[State, State]]  # compiled: start, actions -> the two


def try_out(env: Env, num_envs: int, num_steps: int) -> Trial:
    """Resets and steps `num_envs` environments, with actions -1, 0, 1 and `num_steps` random."""
    keys = jax.random.split(jax.random.key(0), num_envs)
    reset = jax.jit(jax.vmap(env.reset))
    start, restart = reset(_again(keys)), reset(keys)
    shape = (num_envs, env.action_size)
    corners = [jnp.full((1, *shape), number) for number in (-1.0, 0.0, 1.0)]
    noise = jax.random.uniform(jax.random.key(1), (num_steps, *shape), minval=-1.0, maxval=1.0)
    actions = jnp.concatenate([*corners, noise])

    @jax.jit
    def rollout(state: State, actions: Array) -> tuple[State, State]:
        step = jax.vmap(env.step)
        return jax.lax.scan(lambda s, action: (step(s, action),) * 2, state, actions)

    last, states = rollout(_again(start), actions)
    return Trial(start, restart, actions, last, states, rollout)


def check_repeats(env: Env, trial: Trial) -> None:
    """Checks that the environment does the same twice: in two programs, and in one."""
    check_traces(env)
    rule = "reset must be a function of its key alone"
    _check_bits("equal keys", trial.start, trial.restart, rule)
    again = trial.rollout(_again(trial.start), trial.actions)[1]
    rule = "step must be a function of both alone"
    _check_bits("equal states and actions", trial.states, again, rule)


def check_shapes(env: Env) -> None:
    """Verifies what of the protocol shows without computing anything; EnvError as `check_env`."""
    check_members(env)
    fresh = shapes_of_reset(env)
    check_fields(fresh)
    action = jax.ShapeDtypeStruct((env.action_size,), jnp.float32)
    given = f" with an action of env.action_size = {env.action_size} numbers"
    following = _trace(f"step cannot be traced{given}", env.step, fresh, action)
    if not isinstance(following, State):
        raise EnvError(f"step returned a {type(following).__name__}: it must return env.State.")
    _check_same(_specs(fresh), _specs(following))


def shapes_of_reset(env: Env) -> Any:
    """Returns the shapes of what reset returns; EnvError if it cannot be traced."""
    return _trace("reset cannot be traced", env.reset, jax.random.key(0))


def _trace(failed: str, function: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return jax.eval_shape(function, *arguments)
    except Exception as error:
        what = f"{in_words(error)}{own_line(error)}"
        raise EnvError(f"{failed}, as jit needs: {what}") from error


def check_members(env: Env) -> None:
    """Verifies that an environment has what every one has, of the right kind."""
    if isinstance(env, type):
        raise EnvError(f"the environment is a class: give an object, {env.__name__}(...).")
    for name in ("control_timestep", "action_size", "reset", "step"):
        if not hasattr(env, name):
            raise EnvError(
                f"env.{name} is missing: an environment has control_timestep, "
                "action_size, reset and step."
            )
    timestep = env.control_timestep
    if not isinstance(timestep, int | float) or not 0 < timestep < float("inf"):
        raise EnvError(
            f"env.control_timestep is {timestep!r:.60}: it must be a positive number of "
            "seconds (a Python float; a method of that name needs @property above it)."
        )
    size = env.action_size
    if isinstance(size, bool) or not isinstance(size, int | np.integer) or size < 1:
        raise EnvError(f"env.action_size is {size!r}: it must be a positive int.")
    try:
        check_takes("env.reset", env.reset, "key")
        check_takes("env.step", env.step, "state", "action")
    except UserError as error:
        raise EnvError(str(error)) from error


def check_fields(state: Any) -> None:
    """Checks the fields that every trainer reads, from the shapes of one fresh state."""
    if not isinstance(state, State):
        raise EnvError(f"reset returned a {type(state).__name__}: it must return env.State.")
    rules = {"reward": jnp.float32, "terminated": jnp.bool_, "truncated": jnp.bool_}
    scalars = {name: (getattr(state, name), dtype) for name, dtype in rules.items()}
    if not isinstance(state.metrics, dict):
        raise EnvError(f"metrics is a {type(state.metrics).__name__}: it must be a dict.")
    if numbers := [name for name in state.metrics if not isinstance(name, str)]:
        raise EnvError(f"metrics has the name {numbers[0]!r}: names are texts.")
    for name in sorted(RESERVED & state.metrics.keys()):
        raise EnvError(f"metrics has {name!r}, a name of the trainer's: give the metric another.")
    scalars |= {f"metrics[{name!r}]": (x, jnp.float32) for name, x in state.metrics.items()}
    for name, (value, dtype) in scalars.items():
        if not hasattr(value, "dtype") or value.shape != () or value.dtype != dtype:
            raise EnvError(
                f"{name} is {_describe(value)}: it must be an array [] of {jnp.dtype(dtype).name}."
            )
    leaves = jax.tree_util.tree_leaves_with_path(state.observation)
    if not leaves:
        raise EnvError("observation is empty: it must hold at least one float32 array.")
    for path, leaf in leaves:
        if len(path) > 1:
            raise EnvError(
                f"observation{jax.tree_util.keystr(path)} is inside another dict: an observation "
                "is one array, or a dict of arrays. Name its parts 'arm/angle', say."
            )
        if leaf.dtype not in (jnp.float32, jnp.uint8) or leaf.ndim == 0:
            raise EnvError(
                f"observation{jax.tree_util.keystr(path)} is {_describe(leaf)}: its arrays must be "
                "float32, or uint8 if they are pictures, with at least one axis."
            )


def _describe(value: Any) -> str:
    if not hasattr(value, "dtype"):
        return f"a {type(value).__name__}"
    weak = ", weakly typed" if getattr(value, "weak_type", False) else ""
    return f"{value.dtype.name} {list(value.shape)}{weak}"


def _specs(state: State) -> dict[str, str]:
    """Returns path -> description of each leaf."""
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return {jax.tree_util.keystr(path).lstrip("."): _describe(leaf) for path, leaf in leaves}


def _check_same(reset: dict[str, str], step: dict[str, str]) -> None:
    """Names, shapes and dtypes must not depend on where a state came from, or scan fails."""
    for name in sorted(reset.keys() ^ step.keys()):
        where = "reset" if name in reset else "step"
        raise EnvError(f"{name} is in {where}'s state only: reset and step return the same fields.")
    for name, spec in reset.items():
        if spec != step[name] and "weakly" in spec + step[name]:
            raise EnvError(
                f"{name} is weakly typed in one of the two ({spec}; {step[name]}): give it a "
                "dtype, as in jnp.float32(0) or jnp.zeros(())."
            )
        if spec != step[name]:
            raise EnvError(
                f"{name} is {spec} from reset and {step[name]} from step: reset and step must "
                "return the same shapes and dtypes."
            )


def _again(tree: PyTree) -> PyTree:
    """Copies a tree for a second use of its keys, which JAX's key-reuse checking would refuse."""
    return jax.tree.map(lambda x: jax.random.clone(x) if is_key(x) else x, tree)


def check_finite(when: str, state: PyTree) -> None:
    """Checks that every number is finite, and none absurd."""
    for name, value in flatten(state).items():
        # A NaN fails the comparison.
        if np.issubdtype(value.dtype, np.floating) and not (np.abs(value) <= ABSURD).all():
            what = f"{np.abs(value).max():.3g}" if np.isfinite(value).all() else "not finite"
            raise EnvError(
                f"{name} is {what} after {when}: every number must be finite, and at most "
                f"{ABSURD:.0e}, for any actions in [-1, 1], or the episode counts as lost."
            )


def forget_lost() -> None:
    """Lets `lost_part` have no reasons from before."""
    reasons.said.clear()


def lost_part(state: PyTree) -> str:
    """Names what is NaN or absurd in states that were reset because they were lost, or ""."""
    try:
        check_finite("reset", state)
    except EnvError as error:
        return f"{error} {reasons.most()}".strip()
    return ""


def _check_bits(what: str, first: PyTree, second: PyTree, rule: str) -> None:
    other = flatten(second)
    for name, value in flatten(first).items():
        if value.tobytes() != other[name].tobytes():
            raise EnvError(f"{name} differs between two calls with {what}: {rule}.")


def check_differs(state: State) -> None:
    """Different keys must give different starts, or B environments are one."""
    leaves = flatten((state.physics, state.observation, state.task)).values()
    # All of them: two starts may be the same by chance.
    if not any((leaf != leaf[:1]).any() for leaf in leaves):
        raise EnvError(
            "physics, observation and task are the same for different keys: reset must "
            "draw something from its key, or all environments of a batch are one."
        )
