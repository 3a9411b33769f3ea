"""Checks of the model that an environment simulates: its units, and how well it is solved."""

import copy
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from purerl.checks import check_env, watch_physics
from purerl.checks.findings import Finding, ok, warning
from purerl.core.env import Env, State
from purerl.core.records import Array

SOLVED = 0.01  # of what a control step moves: a solver that converged differs by rounding alone
SMALL = np.radians(np.pi)  # a range that was probably written in radians, and read as degrees
LARGE = 4 * np.pi  # one that was written in degrees, and read as radians
SLIDE, NEWTON = 2, 2  # of mujoco.mjtJoint and mjtSolver


def check_model(env: Env, trial: check_env.Trial) -> Iterator[Finding]:
    """Yields what is found of the model of `env.physics`; nothing where there is none."""
    physics: Any = getattr(env, "physics", None)
    if hasattr(physics, "substeps"):
        yield from check_ranges(physics.model)
        yield from check_solver(env, physics, trial)


def check_ranges(model: Any) -> Iterator[Finding]:
    """Warns of joints' ranges of angles that look like degrees read as radians, or the reverse."""
    from purerl.physics import lookup

    turns = np.abs(model.jnt_range).max(1, initial=0.0) * model.jnt_limited  # [njnt] [rad]
    turns[model.jnt_type == SLIDE] = 0.0
    small = (turns > 0) & (turns < SMALL)
    small &= 2 * small.sum() > (turns > 0).sum()  # a file has one unit; a few joints may be stiff
    for unit, odd in (("radians", small), ("degrees", turns > LARGE)):
        for i in np.flatnonzero(odd)[:1]:
            what = (
                f"joint {lookup.names(model, 'joint')[i] or i} turns by {turns[i]:.3g} rad at most"
            )
            cure = f'were they written in {unit}? See <compiler angle="..."/>'
            yield warning("ranges", f"{what}, and {odd.sum()} ranges look like that: {cure}.")


def check_solver(env: Env, physics: Any, trial: check_env.Trial) -> Iterator[Finding]:
    """Compares control steps with those of a solver of many more iterations, both of MuJoCo's C."""
    from purerl.physics.interface import Physics

    def given(state: State, action: Array) -> tuple[Any, Any]:
        with watch_physics.watching(physics) as seen:
            env.step(state, action)
        return seen.calls[0]

    def after(model: Any) -> np.ndarray:
        step = Physics(model, (), physics.substeps, "c").step
        batch = jax.vmap(jax.vmap(lambda call: step(*call[0], **call[1])[0].qpos))
        return np.asarray(jax.jit(batch)(calls))

    solved, opt = copy.copy(physics.model), physics.model.opt
    solved.opt.solver, solved.opt.iterations, solved.opt.ls_iterations = NEWTON, 1000, 500
    try:
        states = jax.tree.map(lambda x, y: jnp.r_[x[None], y[:-1]], trial.start, trial.states)
        calls = jax.jit(jax.vmap(jax.vmap(given)))(states, trial.actions)
        old, own, best = np.asarray(calls[0][0].qpos), after(physics.model), after(solved)
    except Exception:  # a trace of the user's own around the physics
        return
    good = np.isfinite(old + best).all(-1)
    if not good.any():
        return
    gap, moved = (np.abs(x - best)[good].max() for x in (own, old))
    what = f"{opt.iterations} iterations ({opt.ls_iterations} of line search)"
    said = f"after one control step qpos is up to {gap:.2g} from a converged solver's, by {what}"
    mend = "raise them" + ", or take Newton" * (opt.solver != NEWTON)
    if gap <= SOLVED * moved:
        yield ok("solver", said)
    else:
        yield warning("solver", f"{said}; it moves by {moved:.2g}: {mend}.")
