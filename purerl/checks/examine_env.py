"""Checks of an environment that go beyond the protocol: would it learn what is meant?"""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from purerl.checks import check_env, examine_physics
from purerl.checks.findings import Finding, error, ok, warning
from purerl.checks.user_code import in_words, own_line, program_errors
from purerl.core.env import ABSURD, Env, EnvError, State
from purerl.core.errors import one_line, some
from purerl.machine.state_arrays import flatten
from purerl.physics import reasons

NUM_ENVS, NUM_STEPS = 16, 20
STEADY = 1e3  # |mean| beyond so many std: float32 keeps four digits of what varies
LARGE = 1e4  # std beyond which a unit is probably wrong


def examine(env: Env, num_steps: int = NUM_STEPS) -> Iterator[Finding]:
    """Yields what is found of an environment, the cheapest first; stops where it cannot go on."""
    held = getattr(env, "__dict__", {})
    before = dict(held)
    reasons.said.clear()
    try:
        check_env.check_shapes(env)
    except EnvError as broken:
        yield error("protocol", one_line(broken))
        return
    yield ok("protocol", "names, shapes and dtypes")
    changed = sorted(n for n, x in held.items() if before.get(n, env) is not x)
    if changed:
        what = f"reset or step sets env.{changed[0]}, and a compiled program does so only once"
        yield error("own state", f"{what}: what an episode must remember goes into State.task.")
    try:
        with program_errors():  # of a callback
            trial = check_env.try_out(env, max(NUM_ENVS, env.action_size + 1), num_steps)
    except Exception as failed:
        yield error("steps", f"it cannot be stepped: {in_words(failed)}{own_line(failed)}")
        return
    yield _told("same twice", "reset and step", error, check_env.check_repeats, env, trial)
    yield from check_trial(trial)
    if reason := reasons.most():
        yield warning("mujoco", reason)
    yield from examine_physics.examine(env, trial)


def check_trial(trial: check_env.Trial) -> Iterator[Finding]:
    """Yields what is found in what environments did."""
    yield check_keys(trial.start)
    broken = not_finite(trial)
    yield broken
    yield from check_ends(trial)
    if broken.level == "ok":
        yield check_reward(trial)
        yield from check_scale(trial)
        yield from check_pictures(trial)
        yield check_actions(trial)


def first_state(start: State) -> list[Finding]:
    """Returns what to tell of the states that a run begins with: nothing is computed for it.

    Args:
      start: [B, ...], or [S, B, ...] of vmapped seeds, of which the first is looked at.
    """
    if np.ndim(start.reward) > 1:
        start = jax.tree.map(lambda x: x[0], start)
    size = np.shape(start.reward)[0]
    found = [check_keys(start)] if size > 1 else []
    found += _ended(np.asarray(start.terminated))
    return [one for one in found if one.level != "ok"]


def _told(about: str, good: str, bad: Callable, check: Callable, *arguments: Any) -> Finding:
    """Returns the finding of a check that raises EnvError."""
    try:
        check(*arguments)
    except EnvError as broken:
        return bad(about, one_line(broken))
    return ok(about, good)


def check_keys(start: State) -> Finding:
    """Warns of a reset that ignores its key."""
    return _told("keys", "other keys, other starts", warning, check_env.check_differs, start)


def not_finite(trial: check_env.Trial) -> Finding:
    """Names all that is NaN, infinite or absurd: reward terms, metrics, observation entries."""
    found = []
    for name, (start, later) in _leaves(trial).items():
        values = np.concatenate([start[None], later])
        wrong = ~(np.abs(values) <= ABSURD)  # a NaN fails the comparison
        if not wrong.any():
            continue
        entries = wrong.any((0, 1))
        where = f"[{some([str(i) for i in np.flatnonzero(entries)])}]" if entries.ndim else ""
        found.append(f"{name}{where} is {_when(values, wrong, trial.actions)}")
    if found:
        # Metrics are the reward's terms, and say most.
        found.sort(key=lambda line: not line.startswith("metrics"))
        return error("finite", f"{some(found)}; such an episode is lost.")
    return ok("finite", f"every number, in {trial.actions.shape[0]} steps of random actions")


def _when(values: np.ndarray, wrong: np.ndarray, actions: Any) -> str:
    """Tells the first of the wrong values [1 + T, B, ...], and which action brought it."""
    first = tuple(np.argwhere(wrong)[0])
    step, number = first[0], len(values) - 1
    if wrong[1:].reshape(number, -1).any(1).all():
        return f"{values[first]:.3g} after every step"
    if step == 0:
        return f"{values[first]:.3g} when reset returns"
    action = some([f"{x:.3g}" for x in np.asarray(actions[step - 1, first[1]])])
    return f"{values[first]:.3g} for the first time at step {step} of {number}, by [{action}]"


def _leaves(trial: check_env.Trial) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Returns path -> floats [B, ...] at the start and [T, B, ...] after each step."""
    start, later = flatten(trial.start), flatten(trial.states)
    return {n: (x, later[n]) for n, x in start.items() if np.issubdtype(x.dtype, np.floating)}


def _ended(over: np.ndarray) -> Iterator[Finding]:
    """Finds episodes [B] that end before they begin."""
    if over.any():
        what = f"{over.sum()} of {over.size} episodes have ended when reset returns"
        yield error("ends", f"{what}: look at terminated in reset, or start elsewhere.")


def check_ends(trial: check_env.Trial) -> Iterator[Finding]:
    """Finds episodes that end before they begin, or that all last one step."""
    ended = np.asarray(trial.start.terminated | trial.start.truncated)
    first = np.asarray((trial.states.terminated | trial.states.truncated)[0])
    yield from _ended(ended)
    if first.all() and not ended.any():
        yield error("ends", "every episode ends at its first step: look at `terminated`.")
    elif not ended.any():
        yield ok("ends", "no episode begins ended")


def check_reward(trial: check_env.Trial) -> Finding:
    """Warns of a reward that never changes."""
    reward = np.asarray(trial.states.reward)
    if np.ptp(reward) == 0:
        what = f"it is {reward.flat[0]:.3g} at every one of {reward.size} random steps"
        return warning("reward", f"{what}: there is nothing to learn from until it changes.")
    return ok("reward", f"{reward.min():.3g} to {reward.max():.3g} by random actions")


def check_scale(trial: check_env.Trial) -> Iterator[Finding]:
    """Warns of observation entries that are constant, hardly vary, or are huge."""
    number = 0
    for name, (start, later) in _leaves(trial).items():
        if not name.startswith("observation"):
            continue
        values = np.concatenate([start[None], later]).astype(np.float64)
        values = values.reshape(-1, *start.shape[1:])
        mean, std = values.mean(0), values.std(0)
        still, steady = std == 0, (std > 0) & (np.abs(mean) > STEADY * std)
        little = f"varies by less than 1/{STEADY:g} of its mean"
        kinds = {
            "does not vary: leave it out, unless other actions than random ones change it": still,
            f"{little}: take the mean off, or digits are lost": steady,
            f"has a std beyond {LARGE:g}: choose another unit": std > LARGE,
        }
        for what, where in kinds.items():
            if where.any():
                number += 1
                places = some([str(list(map(int, i))) for i in np.argwhere(where)])
                yield warning("scale", f"{name} {places} {what}.")
    if not number:
        yield ok("scale", "every entry of the observation varies, at a sound scale")


def check_pictures(trial: check_env.Trial) -> Iterator[Finding]:
    """Warns of eyes, a picture [H, W] uint8 each, that see nothing, or nothing that moves."""
    start, later = flatten(trial.start.observation), flatten(trial.states.observation)
    for name in (n for n, x in start.items() if x.dtype == np.uint8):
        seen = np.concatenate([start[name][None], later[name]]) / 255.0
        for eye in range(seen.shape[2]) if seen.ndim == 5 else ():
            one, what = seen[:, :, eye], f"eye {eye} of observation/{name}"
            if np.ptp(one) == 0:
                said = f"{what} is the same grey, {one.flat[0]:.2g}, everywhere: nothing is in view"
                yield warning("eyes", f"{said}, or it is closed or inside of something.")
            elif not (moves := np.ptp(one, axis=0).any(0)).any():
                yield warning("eyes", f"{what}: nothing moves in it, whatever the body does.")
            else:
                said = f"contrast {one.std():.2f} (white is 1), {moves.mean():.0%} of pixels move"
                yield ok("eyes", f"{what}: {said}")


def check_actions(trial: check_env.Trial) -> Finding:
    """Warns of entries of the action that change nothing.

    Environments that start alike are given the same actions, but for one entry in each, which has
    the other sign. The bits of those that differ in nothing are the same.
    """
    steps, number, size = trial.actions.shape
    same = jax.tree.map(lambda x: jnp.repeat(x[:1], number, 0), trial.start)
    flips = np.ones((number, size), np.float32)
    flips[1 + np.arange(size), np.arange(size)] = -1.0
    actions = jnp.repeat(trial.actions[:, :1], number, 1) * flips
    states = trial.rollout(same, actions)[1]
    # Not the reward, which may just take the action's cost.
    later = flatten((states.physics, states.observation, states.terminated)).values()
    acts = [(x[:, 1:] != x[:, :1]).any((0, *range(2, x.ndim)))[:size] for x in later]
    idle = np.flatnonzero(~np.any(acts, 0))
    if idle.size:
        what = f"entries {some(list(map(str, idle)))} of {size} change nothing in {steps} steps"
        return warning("actions", f"{what}: is every entry used, and every actuator connected?")
    return ok("actions", f"each of {size} has an effect")
