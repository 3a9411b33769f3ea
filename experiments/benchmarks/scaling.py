"""How cost grows: steps/s and memory over environments, rollout length, width, cores and seeds.

    python -m purerl.experiments.benchmarks.scaling --csv lab/data/scaling.csv
    python -m purerl.experiments.benchmarks.scaling --engine jax --minibatch 4096   # on a GPU

One axis varies, the rest stays as the experiment and its overrides have it; a minibatch holds at
most `--minibatch` samples, so that the learner's work for a sample is the same everywhere. Each
point is a benchmark in a process of its own (memory is the most that process held) and times the
bare physics in turns with the update: the share says what the trainer costs, whatever else the
machine was doing. Over seeds, the rate is that of all seeds together, one program of vmapped
updates.
"""

import argparse
import csv
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax

from purerl import exact
from purerl.core.errors import UserError
from purerl.experiment import objects
from purerl.experiment.command_line import from_command_line
from purerl.experiment.definition import Experiment
from purerl.experiment.loading import find_source
from purerl.experiment.options import Engine
from purerl.experiments.benchmarks.benchmark import compile_part, measure
from purerl.experiments.benchmarks.output import output_file
from purerl.machine.command_errors import leave
from purerl.ppo import algorithm

HERE = sorted(os.sched_getaffinity(0))  # cores that this process may use
AXES: dict[str, tuple[int, ...]] = {
    "envs": (64, 256, 1024, 4096, 16384),
    "length": (8, 32, 128),
    "width": (32, 128, 512),
    "cores": tuple(2**i for i in range(len(HERE).bit_length())),
    "seeds": (1, 2, 4, 8),
}
FIELDS = (
    "axis", "value", "steps_per_s", "physics_steps_per_s", "share", "compile_s", "state_mb",
    "update_mb", "process_mb",
)  # fmt: skip
SHORT = 8  # steps of a rollout over environments: 16,384 of them take long enough


class Sweep(NamedTuple):
    """What stays while one axis varies."""

    name: str  # of the experiment
    words: list[str]  # its overrides, as on the command line
    config: algorithm.Config  # with them
    minibatch: int  # samples, at most


def overrides(axis: str, value: int, config: algorithm.Config, minibatch: int) -> list[str]:
    """Returns the options that put one axis at a value."""
    envs = value if axis == "envs" else config.num_envs
    length = {"envs": SHORT, "length": value}.get(axis, config.rollout_length)
    sizes = {
        "num-envs": envs,
        "rollout-length": length,
        "num-minibatches": max(envs * length // minibatch, 1),
    }
    words = [word for name, size in sizes.items() for word in (f"--ppo.{name}", str(size))]
    if axis == "width":
        for name in ("policy", "value"):
            words += [f"--network.{name}-hidden", str(value), str(value)]
    return words


def point(sweep: Sweep, axis: str, value: int) -> dict[str, Any]:
    """Measures one point in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "found.json"
        command = [
            sys.executable,
            "-m",
            "purerl.experiments.benchmarks.benchmark",
            sweep.name,
            *sweep.words,
        ]
        command += ["--rounds", "2", "--least-s", "0.5", "--json", str(file)]
        command += ["--parts", "physics alone", "update"]
        command += overrides(axis, value, sweep.config, sweep.minibatch)
        if run_on(value if axis == "cores" else len(HERE), command):  # it has told why
            raise UserError(f"Measuring {axis} {value} failed; see above.")
        found = json.loads(file.read_text())
    physics, update = found["parts"]
    held = found["memory"]
    rates = update["steps_per_second"], physics["steps_per_second"]
    return {
        "axis": axis,
        "value": value,
        "steps_per_s": round(rates[0]),
        "physics_steps_per_s": round(rates[1]),
        "share": round(rates[0] / rates[1], 3),
        "compile_s": round(update["compile_s"], 1),
        "state_mb": round(held["state"] / 1e6, 2),
        "update_mb": round(held["update"] / 1e6, 2),
        "process_mb": round(list(held.values())[-1] / 1e6),
    }


def run_on(cores: int, command: list[str]) -> int:
    """Runs a command on the first so many of the cores; returns its exit code."""
    os.sched_setaffinity(0, HERE[:cores])  # a child inherits it
    try:
        return subprocess.run(command, stdout=subprocess.DEVNULL).returncode
    finally:
        os.sched_setaffinity(0, HERE)


def seeds_point(experiment: Experiment, engine: Engine, number: int) -> dict[str, Any]:
    """Measures the update of vmapped seeds."""
    chosen = dataclasses.replace(experiment, engine=engine)
    config, env, network, _ = objects.build(chosen)
    keys = jax.random.split(jax.random.key(chosen.seed), number)
    state = jax.jit(jax.vmap(partial(algorithm.init, config, env, network)))(keys)
    update = jax.vmap(partial(algorithm.update, config, env, network))
    part = compile_part("update", update, (state,), number * config.steps_per_update)
    rate = measure([part], 3, 0.5)[0].steps_per_second
    return {"axis": "seeds", "value": number, "steps_per_s": round(rate),
            "compile_s": round(part.compile_s, 1)}  # fmt: skip


def table(rows: list[dict[str, Any]]) -> str:
    """Formats the points."""
    lines = [f"| {' | '.join(FIELDS)} |", "|" + "---|" * len(FIELDS)]
    lines += [f"| {' | '.join(str(row.get(field, '')) for field in FIELDS)} |" for row in rows]
    return "\n".join(lines)


def write(path: Path, rows: list[dict[str, Any]]) -> None:
    """Writes the points measured, in place of those of the same axes; other axes stay."""
    old = list(csv.DictReader(path.open())) if path.exists() else []
    axes = {row["axis"] for row in rows}
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, FIELDS, lineterminator="\n")
        writer.writeheader()
        writer.writerows([*(row for row in old if row["axis"] not in axes), *rows])


def main(arguments: list[str]) -> int:
    """Measures the axes that the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--axes", nargs="+", choices=tuple(AXES), default=tuple(AXES))
    parser.add_argument("--experiment", default="ant_run", help="takes its overrides, too")
    parser.add_argument("--seeds-experiment", default="cartpole_swingup", help="for the axis seeds")
    parser.add_argument("--minibatch", type=int, default=1024, help="samples, at most")
    parser.add_argument(
        "--csv", type=output_file, default="", help="also write the points to this file"
    )
    options, words = parser.parse_known_args(arguments)
    if options.minibatch < 1:
        parser.error(f"--minibatch is {options.minibatch}; it must be at least 1.")
    seeds = find_source(options.seeds_experiment).experiment
    prog = "python -m purerl.experiments.benchmarks.scaling"
    experiment, _ = from_command_line(find_source(options.experiment), words, prog)
    sweep = Sweep(options.experiment, words, experiment.ppo, options.minibatch)
    exact.set_xla_flags()  # for seeds, in this process
    rows = []
    for axis, value in [(name, value) for name in options.axes for value in AXES[name]]:
        if axis == "seeds":
            rows.append(seeds_point(seeds, experiment.engine, value))
        else:
            rows.append(point(sweep, axis, value))
        print(table(rows).splitlines()[-1], flush=True)
        if options.csv:  # as they come: a whole table takes minutes
            write(Path(options.csv), rows)
    print(table(rows))
    return 0


if __name__ == "__main__":
    leave(lambda: main(sys.argv[1:]))
