"""All checks of an experiment, one after another: its sizes, environment and network, its speed."""

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp

from purerl.checks import examine_env, examine_network, user_code
from purerl.checks.findings import Finding, error, ok, warning
from purerl.core.env import State
from purerl.core.errors import UserError
from purerl.core.records import PyTree
from purerl.devices import memory, shards
from purerl.devices.programs import abstract_state, compile_programs
from purerl.experiment.definition import Experiment
from purerl.experiment.objects import Setup, build, naming_broken_rules
from purerl.ppo.config import Config, Evaluation
from purerl.ppo.learner import is_recurrent

FEW_SAMPLES = 32  # in a minibatch, whose gradient is then mostly noise
FEW_UPDATES = 50  # of a run: a cart-pole had 335 of 1000 after 48, and 901 after 122
OBSERVATIONS = 256  # that a network is tried on, at most
LONGEST = 40.0  # [s] in which it is timed, without compiling
ROLLOUTS = 9  # in that: three alone, three updates, in which learning takes as long as acting
SHARE = 0.5  # of the memory: what the estimate leaves out may be as much again


def examine(chosen: Experiment, speed: bool) -> Iterator[Finding]:
    """Yields what is found of an experiment.

    Args:
      chosen: the experiment, with its overrides.
      speed: whether to measure it too.
    """
    try:
        setup = build(chosen)
    except UserError as broken:
        yield error("build", str(broken))
        return
    with user_code.users_errors(""), naming_broken_rules(setup.env):
        abstract = abstract_state(*setup[:3])
    yield ok("build", f"{type(setup.env).__name__}, engine {setup.engine}")
    found = [check_memory(setup, abstract), check_minibatch(setup, abstract)]
    yield from [*found, *check_settings(setup.config)]
    env_found = []
    for finding in examine_env.examine(setup.env):
        env_found.append(finding)
        yield finding
    if any(one.level == "error" for one in [*found, *env_found]):
        return  # what follows would fail by the same, or fill the memory
    with user_code.users_errors("The network: "):
        few = _starts(setup, min(setup.config.num_envs, OBSERVATIONS))
        yield from examine_network.examine(setup.network, few.observation)
    if speed:
        yield from _speeds(setup, _starts(setup, setup.config.num_envs))


def check_memory(setup: Setup, abstract: PyTree) -> Finding:
    """Compares what a run takes at least with the memory that there is."""
    parts = memory.least(setup.config, abstract, setup.env.action_size)
    has, total = memory.room(), sum(parts.values())
    try:
        memory.check_room(parts, has)
    except ValueError as broken:
        return error("memory", str(broken))
    most = max(parts, key=lambda name: parts[name])
    said = (
        f"a run takes {total / 1e6:,.1f} MB at least, {parts['rollouts'] / 1e6:,.1f} of them for "
        f"rollouts; there are {has / 1e6:,.0f} MB"
    )
    if total > SHARE * has:
        return warning("memory", f"{said}: it may not do, so lower {memory.CURES[most]}.")
    return ok("memory", said)


def check_minibatch(setup: Setup, abstract: PyTree) -> Finding:
    """Warns of minibatches so small that their gradients are noise."""
    config, recurrent = setup.config, is_recurrent(abstract.memory)
    samples = config.steps_per_update // config.num_minibatches
    what = f"{config.num_minibatches} in an update, of {samples:,} steps each"
    if samples < FEW_SAMPLES:
        return warning("minibatches", f"{what}: lower ppo.num_minibatches.")
    whole = f", {config.num_envs // config.num_minibatches} whole rollouts" if recurrent else ""
    return ok("minibatches", what + whole)


def check_settings(config: Config) -> Iterator[Finding]:
    """Warns of a run that ends before it has learned, and of a setting that nothing reads."""
    if config.num_updates < FEW_UPDATES:
        what = f"{config.num_updates} in the whole run, of {config.steps_per_update:,} steps each"
        yield warning("updates", f"{what}: lower ppo.rollout_length, or raise ppo.num_steps.")
    fixed = config.schedule != "adaptive_kl"
    if not fixed and config.num_epochs * config.num_minibatches == 1:
        what = "an update has one minibatch, before which the policy has not moved, so its KL is 0"
        yield warning("schedule", f"{what} and the rate only rises: raise ppo.num_epochs.")
    if fixed and config.desired_kl != Config.desired_kl:
        what = f"nothing reads {config.desired_kl} where ppo.schedule is {config.schedule!r}"
        yield warning("desired_kl", f"{what}: choose 'adaptive_kl', or leave desired_kl out.")


def _starts(setup: Setup, number: int) -> State:
    """Returns fresh environments."""
    return jax.jit(jax.vmap(setup.env.reset))(jax.random.split(jax.random.key(0), number))


def _speeds(setup: Setup, start: State) -> Iterator[Finding]:
    """Measures the environment alone, and an update, of the run's sizes."""
    config, env = setup.config, setup.env
    shape = (config.num_envs, env.action_size)

    @functools.partial(jax.jit, static_argnums=2)
    def steps(state: State, number: int, blind: bool = False) -> State:
        def one(i: Any, state: State) -> State:
            action = jax.random.uniform(jax.random.key(i), shape) * 2 - 1
            later = jax.vmap(env.step)(state, action)
            return _with_pictures_of(state, later) if blind else later

        return jax.lax.fori_loop(0, number, one, state)

    step = _seconds(lambda: steps(start, 1))
    length = timed_steps(config, step)
    what = f"a control step of {config.num_envs} environments takes {step:.2g} s: timing {length}"
    yield ok("speed", f"{what} takes about {ROLLOUTS * length * step:.0f} s, and compiling")
    alone = _seconds(lambda: steps(start, length)) / length
    yield ok("speed", f"{config.num_envs / alone:,.0f} steps/s of the environments alone")
    if any(x.dtype == jnp.uint8 for x in jax.tree.leaves(start.observation)):
        blind = min(_seconds(lambda: steps(start, length, True)) / length, alone)
        share, each = 1.0 - blind / alone, 1e6 * (alone - blind) / config.num_envs
        yield ok("speed", f"{share:.0%} of that are pictures: {each:.0f} us for those of a step")
    number = config.steps_per_update
    short = setup._replace(config=dataclasses.replace(config, rollout_length=length))
    with naming_broken_rules(env):
        programs = compile_programs(
            *short[:3], Evaluation(number=0), True, shards.Shards(), calls_host=setup.engine == "c"
        )
    states = [programs.init(jax.random.key(0))]

    def update() -> Any:
        states[0], metrics = programs.update(states[0])
        return metrics

    whole = _seconds(update) * config.rollout_length / length
    left = config.num_updates * whole
    yield ok(
        "speed",
        f"{number / whole:,.0f} steps/s in an update of {whole:.2f} s: {config.num_updates:,} "
        f"updates take {left / 60:,.1f} min, without evaluations",
    )


def _with_pictures_of(before: State, state: State) -> State:
    """Returns a state with an earlier one's pictures: those that nothing takes are not made."""
    new, old = state.observation, before.observation
    kept = jax.tree.map(lambda x, y: y if x.dtype == jnp.uint8 else x, new, old)
    return state.replace(observation=kept)


def timed_steps(config: Config, seconds: float) -> int:
    """Returns how many control steps an update has that is timed: all, where LONGEST is enough.

    Args:
      config: the run's settings.
      seconds: that a control step of all environments takes.
    """
    least = config.num_minibatches // math.gcd(config.num_minibatches, config.num_envs)
    most = int(LONGEST / (ROLLOUTS * seconds)) // least * least
    return min(config.rollout_length, max(least, most))


def _seconds(function: Callable[[], Any]) -> float:
    """Returns the shorter time of two calls, after one that compiles and warms [s]."""
    times = []
    for _ in range(3):
        begun = time.perf_counter()
        jax.block_until_ready(function())
        times.append(time.perf_counter() - begun)
    return min(times[1:])
