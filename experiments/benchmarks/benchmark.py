"""Where time and memory go: physics, eyes, rollout, learner, update, evaluation of an experiment.

    python -m purerl.experiments.benchmarks.benchmark ant_run
    python -m purerl.experiments.benchmarks.benchmark ant_run --engine jax --json out.json
    python -m purerl.experiments.benchmarks.benchmark ant_run --start-up # time to the first update

Each part is compiled by itself and timed in rounds, part after part, so that a busy moment of the
machine falls on all of them; the median of the rounds counts. Rates are control steps per second.
"Physics alone" is the bare engine under random controls: no network, no reward, no observation.
"Eyes" is what they see of the start, as often: neither physics nor blur or noise.
"Busy" is the share of the time in which a GPU ran a kernel: the rest are gaps, left by the host.

Memory: the run's state; one update, its state and what the compiled program needs beside it; and
the most that the device has held, where it counts, or else the process, everything included (the
`c` engine's simulations too, which XLA does not see). What `warp` keeps on a GPU is not in it.
"""

import argparse
import json
import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from purerl import exact
from purerl.core.records import Array, PyTree, TrainState
from purerl.devices.memory import size
from purerl.experiment import command_line, objects
from purerl.experiment.definition import Experiment
from purerl.experiment.loading import find_source
from purerl.experiments.benchmarks import start_up
from purerl.experiments.benchmarks.output import count, output_file
from purerl.machine.command_errors import leave
from purerl.physics.lookup import scale_action
from purerl.ppo import algorithm
from purerl.ppo.evaluation import evaluate_policy
from purerl.ppo.rollout import rollout

PARTS = ("physics alone", "eyes", "rollout", "learner", "update", "evaluation")


class Part(NamedTuple):
    """One program to time."""

    name: str
    call: Callable[[], PyTree]
    steps: int | None  # control steps it takes; None: as many as its result says
    compile_s: float
    temporary: int  # bytes that it needs beside its arguments and results


class Bench(NamedTuple):
    """An experiment's programs, and the state that they share."""

    parts: list[Part]
    state: TrainState
    num_envs: int


class Timing(NamedTuple):
    """What was measured of one part."""

    name: str
    compile_s: float
    seconds: float  # median of the rounds
    steps_per_second: float
    busy: float | None = None  # share of the time in which a GPU ran a kernel


def bare_physics(env: Any, config: algorithm.Config, state: TrainState, key: Array) -> PyTree:
    """Steps the engine alone for one rollout, from the environments' states [B]."""
    size = config.num_envs, env.action_size

    def step(physics: PyTree, t: Array) -> tuple[PyTree, None]:
        action = jax.random.uniform(jax.random.fold_in(key, t), size, minval=-1.0, maxval=1.0)
        ctrl = jax.vmap(partial(scale_action, env.physics.model))(action)
        changes: Callable = getattr(env, "model_changes", lambda _: {})
        changed = jax.vmap(changes)(state.env_state)
        following, _ = jax.vmap(env.physics.step)(physics, ctrl, changed)
        # One that blows up starts again, so that all are worth their time.
        lost = ~jnp.isfinite(following.qpos).all(axis=1)
        following = jax.tree.map(
            lambda a, b: jnp.where(jnp.expand_dims(lost, tuple(range(1, a.ndim))), b, a),
            following,
            state.env_state.physics,
        )
        return following, None

    return jax.lax.scan(step, state.env_state.physics, jnp.arange(config.rollout_length))[0]


def eyes_alone(env: Any, config: algorithm.Config, state: TrainState) -> Array:
    """Looks once in each control step of a rollout; returns the last pictures [B, E, H, W]."""

    def places(state: Any) -> tuple:
        changes = env.model_changes(state) if hasattr(env, "model_changes") else {}
        readings = env.physics.init(state.physics.qpos, state.physics.qvel, changes)[1]
        boxes = env.scenery(state) if hasattr(env, "scenery") else None
        return readings.xpos, readings.xmat, boxes

    xpos, xmat, boxes = jax.vmap(places)(state.env_state)

    def look(seen: Array, t: Array) -> tuple[Array, None]:
        # A little farther each time, or XLA would look once.
        return jax.vmap(env.eyes.see)(xpos + 1e-4 * t, xmat, boxes), None

    first = jax.vmap(env.eyes.see)(xpos, xmat, boxes)
    return jax.lax.scan(look, first, jnp.arange(1, config.rollout_length))[0]


def make_bench(experiment: Experiment, names: Sequence[str] = PARTS) -> Bench:
    """Compiles the parts of an experiment on its engine."""
    config, env, network, _ = objects.build(experiment)
    key = jax.random.key(experiment.seed)
    state = jax.jit(partial(algorithm.init, config, env, network))(key)
    seen = None
    if "learner" in names:  # it needs something to learn from
        state, seen = jax.jit(partial(algorithm.collect, config, env, network))(state)
    steps, episodes = config.steps_per_update, experiment.evaluation.num_episodes
    programs: list[tuple[str, Callable, tuple, int | None]] = [
        ("physics alone", partial(bare_physics, env, config), (state, key), steps),
        ("eyes", partial(eyes_alone, env, config), (state,), steps),
        ("rollout", partial(rollout, config, env, network), (state,), steps),
        ("learner", partial(algorithm.improve, config, network), (state, seen), steps),
        ("update", partial(algorithm.update, config, env, network), (state,), steps),
        (
            "evaluation",
            partial(
                evaluate_policy,
                env,
                network,
                num_episodes=episodes,
                episode_length=config.episode_length,
            ),
            (state, key),
            None,
        ),
    ]
    absent = {"physics alone"} if not hasattr(env, "physics") else set()
    absent |= {"eyes"} if not getattr(env, "eyes", None) else set()
    chosen = [program for program in programs if program[0] in set(names) - absent]
    parts = [compile_part(*program) for program in chosen]
    return Bench(parts, state, config.num_envs)


def compile_part(name: str, function: Callable, arguments: tuple, steps: int | None) -> Part:
    """Compiles one part and runs it once."""
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    seconds = time.perf_counter() - start
    jax.block_until_ready(compiled(*arguments))
    analysis = compiled.memory_analysis()  # None where XLA tells nothing
    temporary = analysis.temp_size_in_bytes if analysis else 0
    return Part(name, lambda: compiled(*arguments), steps, seconds, temporary)


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
    return [
        Timing(p.name, p.compile_s, medians[p.name], steps[p.name] / medians[p.name], busy(p))
        for p in parts
    ]


def busy(part: Part) -> float | None:
    """Returns the share of a call in which the GPU ran a kernel, None without a GPU.

    What is missing to 1 are gaps: the GPU waits for the host to tell it what to do next.
    """
    if jax.default_backend() != "gpu":
        return None
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            start = time.perf_counter()
            jax.block_until_ready(part.call())
            seconds = time.perf_counter() - start
        file = next(Path(folder).rglob("*.xplane.pb"))
        return kernel_seconds(jax.profiler.ProfileData.from_file(str(file)).planes) / seconds


def kernel_seconds(planes: Iterable[Any]) -> float:
    """Adds up the events on the GPUs' streams, of a profile's planes."""
    gpus = [plane for plane in planes if plane.name.startswith("/device:GPU")]
    streams = [line for plane in gpus for line in plane.lines if line.name.startswith("Stream")]
    return sum(event.duration_ns for stream in streams for event in stream.events) * 1e-9


def memory(bench: Bench) -> dict[str, int]:
    """Returns what -> bytes.

    An update of a run works on its own state: the new one takes the place of the old one.
    """
    found = {"state": size(jax.eval_shape(lambda: bench.state))}
    for part in bench.parts:
        if part.name == "update":
            found["update"] = found["state"] + part.temporary
    counted = jax.devices()[0].memory_stats()
    if counted:
        return found | {"device, at most": counted["peak_bytes_in_use"]}
    kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # as Linux counts
    return found | {"process, at most": 1024 * kib}


def memory_table(found: dict[str, int], num_envs: int) -> str:
    """Formats what -> bytes."""
    lines = ["| memory | MB | bytes per environment |", "|---|---|---|"]
    lines += [f"| {k} | {v / 1e6:,.1f} | {v / num_envs:,.0f} |" for k, v in found.items()]
    return "\n".join(lines)


def table(timings: list[Timing]) -> str:
    """Formats the timings, with each rate's share of the first part's."""
    lines = [
        "| part | compile [s] | seconds | steps/s | share | busy |",
        "|---|---|---|---|---|---|",
    ]
    for t in timings:
        share = t.steps_per_second / timings[0].steps_per_second
        kernels_run = "" if t.busy is None else f"{t.busy:.2f}"
        lines.append(
            f"| {t.name} | {t.compile_s:.1f} | {t.seconds:.4f} | {t.steps_per_second:,.0f} "
            f"| {share:.2f} | {kernels_run} |"
        )
    return "\n".join(lines)


def main(arguments: list[str]) -> int:
    """Measures the experiment that the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("experiment", help="as for python -m purerl.run, with its overrides")
    parser.add_argument("--rounds", type=count, default=5, help="rounds of the measurement")
    parser.add_argument("--least-s", type=float, default=1.0, help="least time of a part [s]")
    parser.add_argument(
        "--json", type=output_file, default="", help="also write the figures to this file"
    )
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="only these")
    parser.add_argument("--start-up", action="store_true", help="time a cold and a warm start")
    options, overrides = parser.parse_known_args(arguments)
    if options.start_up:
        return start_up.main([options.experiment, *overrides])
    exact.set_xla_flags()  # as a run does, before JAX starts
    prog = f"python -m purerl.experiments.benchmarks.benchmark {options.experiment}"
    experiment, _ = command_line.from_command_line(find_source(options.experiment), overrides, prog)
    bench = make_bench(experiment, options.parts)
    timings = measure(bench.parts, options.rounds, options.least_s)
    held = memory(bench)
    device = jax.devices()[0].device_kind
    print(f"{options.experiment} {' '.join(overrides)} on {device}\n{table(timings)}\n")
    print(memory_table(held, bench.num_envs))
    if options.json:
        rows = [timing._asdict() for timing in timings]
        about = {"experiment": options.experiment, "overrides": overrides, "device": device}
        with open(options.json, "w") as file:
            json.dump(about | {"parts": rows, "memory": held}, file)
    return 0


if __name__ == "__main__":
    leave(lambda: main(sys.argv[1:]))
