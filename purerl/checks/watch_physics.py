"""What an environment's functions hand to its physics, seen while they are traced."""

import contextlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from purerl.checks.check_env import Trial
from purerl.checks.findings import Finding, error, ok, warning
from purerl.core.env import Env, State
from purerl.core.records import Array

TINY = 1e-5  # of a range: what rounding may do


class Seen(NamedTuple):
    """Calls of one trace, in order."""

    controls: list[Array]  # [nu] that `step` was given
    states: list[Any]  # PhysicsState that `init` and `step` returned
    calls: list[tuple]  # positional and named arguments


@contextlib.contextmanager
def watching(physics: Any) -> Iterator[Seen]:
    """Notes what `physics` is given and what it returns, as long as this lasts."""
    seen = Seen([], [], [])

    def init(*arguments: Any, **named: Any) -> Any:
        answer = type(physics).init(physics, *arguments, **named)
        seen.states.append(answer[0])
        seen.calls.append((arguments, named))
        return answer

    def step(state: Any, ctrl: Array, *arguments: Any, **named: Any) -> Any:
        answer = type(physics).step(physics, state, ctrl, *arguments, **named)
        seen.controls.append(jnp.asarray(ctrl))
        seen.states.append(answer[0])
        seen.calls.append(((state, ctrl, *arguments), named))
        return answer

    physics.init, physics.step = init, step
    try:
        yield seen
    finally:
        del physics.init, physics.step


def check_controls(env: Env, trial: Trial) -> list[Finding]:
    """Warns of controls that MuJoCo clamps: what lies beyond is an action without effect."""
    physics: Any = getattr(env, "physics", None)
    if not hasattr(physics, "model") or not physics.model.nu:
        return []

    def controls(state: State, action: Array) -> list[Array]:
        with watching(physics) as seen:
            env.step(state, action)
        return seen.controls

    try:
        # Only the controls are asked for, so that nothing is simulated.
        batch = jax.jit(jax.vmap(jax.vmap(controls, (0, 0)), (None, 0)))
        given = [np.asarray(x) for x in batch(trial.start, trial.actions)]
    except Exception:  # a trace of the user's own around the physics
        return []
    return [_describe_controls(physics.model, np.stack(given))] if given else []


def _describe_controls(model: Any, given: np.ndarray) -> Finding:
    """Compares controls [..., nu] with the range of each actuator."""
    from purerl.physics import lookup

    flat = given.reshape(-1, model.nu)
    least, most = flat.min(0), flat.max(0)
    low, high = model.actuator_ctrlrange.T
    slack = TINY * np.maximum(high - low, 1.0)
    beyond = model.actuator_ctrllimited.astype(bool) & (
        (least < low - slack) | (most > high + slack)
    )
    names = lookup.names(model, "actuator")
    if not beyond.any():
        return ok("controls", f"of {model.nu} actuators, none beyond its ctrlrange")
    i = int(np.argmax(beyond))
    return warning(
        "controls",
        f"{beyond.sum()} of {model.nu} actuators are driven beyond their ctrlrange, where MuJoCo "
        f"clamps: {names[i] or i} gets {least[i]:.3g} to {most[i]:.3g}, and has {low[i]:.3g} to "
        f"{high[i]:.3g}; map actions by lookup.scale_action.",
    )


def check_placed(env: Env, num_envs: int = 4) -> list[Finding]:
    """Finds quaternions of zeros, and positions that reset changes after `init`.

    The first readings, and so the first observation, are of where things were before.
    """
    physics: Any = getattr(env, "physics", None)
    if not hasattr(physics, "model"):
        return []

    from purerl.physics.as_built import ZERO_ROTATION, has_zero_rotation

    def places(key: Array) -> tuple[Any, Any, Any]:
        with watching(physics) as seen:
            after = env.reset(key).physics
        names = ("mocap_pos", "mocap_quat", "qpos", "qvel")
        before = seen.states[-1]
        arguments, named = seen.calls[-1]
        given = {**dict(zip(("qpos", "qvel", "changes"), arguments, strict=False)), **named}
        zero = has_zero_rotation(physics.model, given["qpos"], given.get("changes") or {})
        old, new = ({n: getattr(x, n) for n in names} for x in (before, after))
        return zero, old, new

    try:
        zero, before, after = jax.jit(jax.vmap(places))(
            jax.random.split(jax.random.key(0), num_envs)
        )
    except Exception:  # `physics` is something else, or in a trace of the user's own
        return []
    if np.any(zero):
        return [error("placing", ZERO_ROTATION)]
    moved = [name for name in before if (np.asarray(before[name]) != after[name]).any()]
    if not moved:
        return [ok("placing", "reset changes no position after init")]
    cure = "the qpos and qvel that init is given"
    if moved[0].startswith("mocap"):
        cure = f'init\'s changes={{"body_{moved[0].removeprefix("mocap_")}": ...}}'
    return [
        warning(
            "placing",
            f"reset changes {' and '.join(moved)} after init, so that the first observation is of "
            f"the old place: put it there by {cure}.",
        )
    ]
