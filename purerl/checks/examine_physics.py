"""Checks of an environment's physics: what it is told while it is traced; its units, its solver."""

import contextlib
import copy
import functools
import inspect
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from purerl.checks.check_env import Trial
from purerl.checks.findings import Finding, error, ok, warning
from purerl.core.env import State
from purerl.core.records import Array
from purerl.physics import lookup
from purerl.physics.changes import ZERO_ROTATION, has_zero_rotation, idle_rows
from purerl.physics.interface import Physics

TINY = 1e-5  # of a range: what rounding may do
FAR = 0.05  # [rad or m] from where a servo holds
SOLVED = 0.01  # of what a control step moves: a solver that converged differs by rounding alone
SMALL = np.radians(np.pi)  # a range that was probably written in radians, and read as degrees
LARGE = 4 * np.pi  # one that was written in degrees, and read as radians
SLIDE, NEWTON = 2, 2  # of mujoco.mjtJoint and mjtSolver


# A call of a physics: "init" or "step", arguments by name, the PhysicsState that it returned.
Call = tuple[str, dict[str, Any], Any]


def examine(env: Any, trial: Trial) -> Iterator[Finding]:
    """Yields what is found of `env.physics`; nothing where that is no purerl.Physics."""
    if hasattr(getattr(env, "physics", None), "substeps"):
        yield from check_controls(env, trial)
        yield from check_placed(env)
        yield from check_ranges(env.physics.model)
        yield from check_solver(env, trial)


@contextlib.contextmanager
def watching(physics: Any) -> Iterator[list[Call]]:
    """Notes the calls of `physics`, in order, as long as this lasts."""
    calls: list[Call] = []

    def noted(name: str, *arguments: Any, **named: Any) -> Any:
        function = functools.partial(getattr(type(physics), name), physics)
        answer = function(*arguments, **named)
        given = inspect.signature(function).bind(*arguments, **named).arguments
        calls.append((name, given, answer[0]))
        return answer

    physics.init, physics.step = (functools.partial(noted, name) for name in ("init", "step"))
    try:
        yield calls
    finally:
        del physics.init, physics.step


def step_calls(env: Any, state: State, action: Array) -> list[Call]:
    """Returns the calls of a control step."""
    with watching(env.physics) as calls:
        env.step(state, action)
    return calls


def check_controls(env: Any, trial: Trial) -> Iterator[Finding]:
    """Warns of controls that MuJoCo clamps: what lies beyond is an action without effect."""
    model = env.physics.model

    def controls(state: State, action: Array) -> list[Array]:
        calls = step_calls(env, state, action)
        return [given["ctrl"] for name, given, _ in calls if name == "step"]

    try:
        # Only the controls are asked for, so that nothing is simulated.
        batch = jax.jit(jax.vmap(jax.vmap(controls, (0, 0)), (None, 0)))
        given = [np.asarray(x) for x in batch(trial.start, trial.actions)]
    except Exception:  # a trace of the user's own around the physics
        return
    if not given or not model.nu:
        return
    flat = np.stack(given).reshape(-1, model.nu)
    least, most = flat.min(0), flat.max(0)
    low, high = model.actuator_ctrlrange.T
    slack = TINY * np.maximum(high - low, 1.0)
    over = model.actuator_ctrllimited.astype(bool) & ((least < low - slack) | (most > high + slack))
    names = lookup.names(model, "actuator")
    if not over.any():
        yield ok("controls", f"of {model.nu} actuators, none beyond its ctrlrange")
        return
    i = int(np.argmax(over))
    yield warning(
        "controls",
        f"{over.sum()} of {model.nu} actuators are driven beyond their ctrlrange, where MuJoCo "
        f"clamps: {names[i] or i} gets {least[i]:.3g} to {most[i]:.3g}, and has {low[i]:.3g} to "
        f"{high[i]:.3g}; map actions by lookup.scale_action.",
    )


def check_placed(env: Any, num_envs: int = 4) -> list[Finding]:
    """Finds what the physics is told wrongly or late, in an episode's reset and its first step.

    The first readings, and so the first observation, are of what `init` was given.
    """
    physics = env.physics

    def begin(key: Array) -> Begun:
        with watching(physics) as calls:
            state = env.reset(key)
            resets = len(calls)
            env.step(state, jnp.zeros(env.action_size))
        (_, given, before), *later = calls[resets - 1 : resets + 1]
        return Begun(given, later[0][1] if later else {}, before, state.physics)

    try:
        begun = jax.jit(jax.vmap(begin))(jax.random.split(jax.random.key(0), num_envs))
    except Exception:  # `physics` is something else, or in a trace of the user's own
        return []
    begun = jax.tree.map(np.asarray, begun)
    wrong = [*_find_zeros(physics, begun), *_find_moved(begun), *_find_unheld(physics, begun)]
    placed = wrong or [ok("placing", "reset changes no position after init")]
    return placed + list(check_changes(physics, begun))


class Begun(NamedTuple):
    """What physics was given in the resets of N environments and their first steps, [N, ...]."""

    given: dict[str, Any]  # arguments of init
    later: dict[str, Any]  # arguments of the first step, by an action of zeros
    before: Any  # PhysicsState that init returned
    after: Any  # that of the state that reset returned


def _find_zeros(physics: Any, begun: Begun) -> Iterator[Finding]:
    """Finds quaternions of zeros."""
    changes = begun.given.get("changes") or {}
    for i, qpos in enumerate(begun.given["qpos"]):
        if has_zero_rotation(physics.model, qpos, {n: x[i] for n, x in changes.items()}):
            yield error("placing", ZERO_ROTATION)
            return


def _find_moved(begun: Begun) -> Iterator[Finding]:
    """Finds parts of the state that reset changes after init."""
    names = ("mocap_pos", "mocap_quat", "qpos", "qvel", "act")
    moved = [n for n in names if (getattr(begun.before, n) != getattr(begun.after, n)).any()]
    if moved:
        cure = f"the {moved[0]} that init is given"
        if moved[0].startswith("mocap"):
            cure = f'init\'s changes={{"body_{moved[0].removeprefix("mocap_")}": ...}}'
        yield warning(
            "placing",
            f"reset changes {' and '.join(moved)} after init, so that the first observation is of "
            f"the old place: put it there by {cure}.",
        )


def _find_unheld(physics: Any, begun: Begun) -> Iterator[Finding]:
    """Finds position servos that the first step holds near their place, and init does not."""
    model, step = physics.model, begun.later.get("ctrl")
    servo = (model.actuator_biasprm[:, 1] != 0) & (model.actuator_dyntype == 0)
    servo &= (model.actuator_ctrlnum == 1) & (model.actuator_outnum == 1)
    if step is None or not (physics.reads_forces and servo.any()):
        return
    init = begun.given.get("ctrl")
    init = np.zeros_like(step) if init is None else init
    lengths = jax.vmap(Physics(model, ("actuator_length",), 1, "c").init)
    at = np.asarray(lengths(begun.given["qpos"], begun.given["qvel"])[1].actuator_length)
    control, at = model.actuator_ctrladr[servo], at[:, model.actuator_outadr[servo]]
    gap = np.abs(init[:, control] - at) - np.abs(step[:, control] - at)
    env, i = np.unravel_index(np.argmax(gap), gap.shape)
    if gap[env, i] > FAR:
        name = lookup.names(model, "actuator")[control[i]] or control[i]
        yield warning(
            "placing",
            f"the first observation is under ctrl {init[env, control[i]]:.3g} of servo {name}, "
            f"which is at {at[env, i]:.3g}; the first step gives it {step[env, control[i]]:.3g}: "
            "give init the ctrl=... that holds the pose.",
        )


def check_changes(physics: Any, begun: Begun) -> Iterator[Finding]:
    """Finds changes of the model that are half, that cannot act, or that a call forgets."""
    own, found = physics.model, dict[str, Any]()
    for call, more in (("init", begun.given), ("step", begun.later)):
        changes = found[call] = more.get("changes") or {}
        for i in range(len(begun.given["qpos"])):
            try:
                physics.check_changes({name: value[i] for name, value in changes.items()})
            except ValueError as wrong:
                yield error("changes", f"of {call}: {wrong}")
                return
    for call, other in (("init", "step"), ("step", "init")):
        for name, value in found[call].items():
            rows = (value != np.float32(getattr(own, name))).any(0)
            rows = rows.reshape(len(rows), -1).any(1)
            if name in ("body_pos", "body_quat"):
                rows &= own.body_mocapid < 0  # there it says where init puts it
            if (rows & idle_rows(own, physics.engine, name)).any():
                what = f"changes[{name!r}] differs from the model in rows that nothing heeds"
                yield warning("changes", f"{what}: {np.flatnonzero(rows)[:6].tolist()}.")
            if rows.any() and name not in found[other]:
                what = f"changes[{name!r}] is given to {call} and not to {other}"
                cure = "which takes the model's own: give each call all of them."
                yield warning("changes", f"{what}, {cure}")


def check_ranges(model: Any) -> Iterator[Finding]:
    """Warns of joints' ranges of angles that look like degrees read as radians, or the reverse."""
    turns = np.abs(model.jnt_range).max(1, initial=0.0) * model.jnt_limited  # [njnt] [rad]
    turns[model.jnt_type == SLIDE] = 0.0
    small = (turns > 0) & (turns < SMALL)
    small &= 2 * small.sum() > (turns > 0).sum()  # a file has one unit; a few joints may be stiff
    for unit, odd in (("radians", small), ("degrees", turns > LARGE)):
        for i in np.flatnonzero(odd)[:1]:
            name = lookup.names(model, "joint")[i] or i
            what = f"joint {name} turns by {turns[i]:.3g} rad at most"
            cure = f'were they written in {unit}? See <compiler angle="..."/>'
            yield warning("ranges", f"{what}, and {odd.sum()} ranges look like that: {cure}.")


def check_solver(env: Any, trial: Trial) -> Iterator[Finding]:
    """Compares control steps with those of a solver of many more iterations, both of MuJoCo's C."""

    def after(model: Any) -> np.ndarray:
        step = Physics(model, (), physics.substeps, "c").step
        batch = jax.vmap(jax.vmap(lambda given: step(**given)[0].qpos))
        return np.asarray(jax.jit(batch)(calls))

    physics, first = env.physics, lambda state, action: step_calls(env, state, action)[0][1]
    solved, opt = copy.copy(physics.model), physics.model.opt
    solved.opt.solver, solved.opt.iterations, solved.opt.ls_iterations = NEWTON, 1000, 500
    try:
        states = jax.tree.map(lambda x, y: jnp.r_[x[None], y[:-1]], trial.start, trial.states)
        calls = jax.jit(jax.vmap(jax.vmap(first)))(states, trial.actions)
        old, own, best = np.asarray(calls["state"].qpos), after(physics.model), after(solved)
    except Exception:  # a trace of the user's own around the physics
        return
    good = np.isfinite(old + best).all(-1)
    if not good.any():
        return
    if physics.engine == "jax" and (solved.eq_type < 2).any():
        what = "MJX has connects and welds without the change of their Jacobian: what they hold"
        yield warning("solver", f"{what} accelerates wrongly while it turns fast.")
    gap, moved = (np.abs(x - best)[good].max() for x in (own, old))
    what = f"{opt.iterations} iterations ({opt.ls_iterations} of line search)"
    said = f"after one control step qpos is up to {gap:.2g} from a converged solver's, by {what}"
    mend = "raise them" + ", or take Newton" * (opt.solver != NEWTON)
    if gap <= SOLVED * moved:
        yield ok("solver", said)
    else:
        yield warning("solver", f"{said}; it moves by {moved:.2g}: {mend}.")
