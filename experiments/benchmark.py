"""Where the time goes: physics alone, rollout, learner, whole update, evaluation of an experiment.

    python -m experiments.benchmark ant_run
    python -m experiments.benchmark ant_run --engine jax --ppo.num-envs 4096 --json out.json

Each part is compiled by itself and timed in rounds, part after part, so that a busy moment of the
machine falls on all of them; the median of the rounds counts. Rates are control steps per second.
"Physics alone" is the bare engine under random controls: no network, no reward, no observation.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from purerl import cli, ppo, run, rundir
from purerl.evaluation import evaluate
from purerl.experiment import Experiment, find
from purerl.model import scale_action
from purerl.rollout import rollout
from purerl.types import Array, PyTree, TrainState


class Part(NamedTuple):
    """One program to time."""

    name: str
    call: Callable[[], PyTree]
    steps: int | None  # control steps it takes; None: as many as its result says
    compile_s: float


class Timing(NamedTuple):
    """What was measured of one part."""

    name: str
    compile_s: float
    seconds: float  # median of the rounds
    steps_per_second: float


def bare_physics(env: Any, config: ppo.Config, state: TrainState, key: Array) -> PyTree:
    """Steps the engine alone for one rollout, from the environments' states [B]."""
    size = config.num_envs, env.action_size

    def step(physics: PyTree, t: Array) -> tuple[PyTree, None]:
        action = jax.random.uniform(jax.random.fold_in(key, t), size, minval=-1.0, maxval=1.0)
        ctrl = jax.vmap(partial(scale_action, env.physics.model))(action)
        changes = getattr(env, "model_changes", lambda _: {})
        changed = jax.vmap(changes)(state.env)
        following, _ = jax.vmap(env.physics.step)(physics, ctrl, changed)
        # One that blows up starts again, so that all are worth their time.
        lost = ~jnp.isfinite(following.qpos).all(axis=1)
        following = jax.tree.map(
            lambda a, b: jnp.where(jnp.expand_dims(lost, tuple(range(1, a.ndim))), b, a),
            following,
            state.env.physics,
        )
        return following, None

    return jax.lax.scan(step, state.env.physics, jnp.arange(config.rollout_length))[0]


def make_parts(experiment: Experiment, num_episodes: int) -> list[Part]:
    """Compiles every part of an experiment on its engine."""
    config, env, network, _ = rundir.build(experiment)
    key = jax.random.key(experiment.seed)
    state = jax.jit(partial(ppo.init, config, env, network))(key)
    state, transitions, _, last = jax.jit(partial(rollout, config, env, network))(state)
    first = state.episode.length == 0
    batch = jax.jit(partial(ppo.make_batch, config))(state, transitions, last, first)
    steps = config.steps_per_update
    programs: list[tuple[str, Callable, tuple, int | None]] = [
        ("physics alone", partial(bare_physics, env, config), (state, key), steps),
        ("rollout", partial(rollout, config, env, network), (state,), steps),
        ("learner", partial(ppo.learn, config, network), (state, batch, state.carry), steps),
        ("update", partial(ppo.update, config, env, network), (state,), steps),
        (
            "evaluation",
            partial(evaluate, config, env, network, num_episodes=num_episodes),
            (state, key),
            None,
        ),
    ]
    if not hasattr(env, "physics"):
        programs = programs[1:]
    return [compile_part(*program) for program in programs]


def compile_part(name: str, function: Callable, arguments: tuple, steps: int | None) -> Part:
    """Compiles one part and runs it once."""
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    seconds = time.perf_counter() - start
    jax.block_until_ready(compiled(*arguments))
    return Part(name, lambda: compiled(*arguments), steps, seconds)


def measure(parts: list[Part], rounds: int, least_s: float) -> list[Timing]:
    """Times the parts in rounds; each call is repeated until it has taken `least_s`."""
    samples: dict[str, list[float]] = {part.name: [] for part in parts}
    steps = {part.name: part.steps or 0 for part in parts}
    for _ in range(rounds):
        for part in parts:
            start, calls = time.perf_counter(), 0
            while calls == 0 or time.perf_counter() - start < least_s:
                result = jax.block_until_ready(part.call())
                calls += 1
            samples[part.name].append((time.perf_counter() - start) / calls)
            if part.steps is None:
                steps[part.name] = int(result["episode_length"].sum())
    medians = {name: statistics.median(values) for name, values in samples.items()}
    return [Timing(p.name, p.compile_s, medians[p.name], steps[p.name] / medians[p.name])
            for p in parts]  # fmt: skip


def table(timings: list[Timing]) -> str:
    """Formats the timings, with each rate's share of the first part's."""
    lines = ["| part | compile [s] | seconds | steps/s | share |", "|---|---|---|---|---|"]
    for t in timings:
        share = t.steps_per_second / timings[0].steps_per_second
        lines.append(
            f"| {t.name} | {t.compile_s:.1f} | {t.seconds:.4f} | {t.steps_per_second:,.0f} "
            f"| {share:.2f} |"
        )
    return "\n".join(lines)


def main(arguments: list[str]) -> int:
    """Measures the experiment that the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("experiment", help="as for python -m purerl.run, with its overrides")
    parser.add_argument("--rounds", type=int, default=5, help="rounds of the measurement")
    parser.add_argument("--least-s", type=float, default=1.0, help="least time of a part [s]")
    parser.add_argument("--json", default="", help="also write the figures to this file")
    options, overrides = parser.parse_known_args(arguments)
    prog = f"python -m experiments.benchmark {options.experiment}"
    experiment, _ = run.from_command_line(cli.parse, find(options.experiment), overrides, prog)
    timings = measure(
        make_parts(experiment, experiment.evaluation.num_episodes), options.rounds, options.least_s
    )
    device = jax.devices()[0].device_kind
    print(f"{options.experiment} {' '.join(overrides)} on {device}\n{table(timings)}")
    if options.json:
        rows = [timing._asdict() for timing in timings]
        with open(options.json, "w") as file:
            json.dump({"experiment": options.experiment, "device": device, "parts": rows}, file)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
