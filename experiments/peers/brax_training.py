"""brax's PPO with its published settings, and its returns beside those of our own settings.

    python -m purerl.experiments.peers.brax_training train ant --seeds 0 1 2 --json brax_ant.json
    python -m purerl.run experiments/peers/brax_ant.py --num-seeds 8 --seed 20
    python -m purerl.experiments.peers.brax_training table ant brax_ant.json runs/brax_ant

brax's settings are those of `experiments/peers/brax_peer.py`; it keeps XLA's own choice of kernels.
The first seed is from cold: an empty compilation cache (of its own folder, unless `--cache` names
one), building and compiling included, importing not. Later seeds find what it compiled. Evaluations
are of 128 episodes of the deterministic policy, the first one before training, as brax counts them.
No run is begun after the time limit, and the file is written after every run.

The table's seconds are of a run from its start; seeds that ran vmapped took them together.
"""

import argparse
import importlib
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from purerl.core.errors import UserError
from purerl.experiments.benchmarks.output import output_file
from purerl.experiments.benchmarks.suite_scores import METRIC, evaluations
from purerl.experiments.peers.brax_peer import BODIES, Published, resize, train_brax
from purerl.machine.command_errors import leave
from purerl.report import bootstrap, run_reader

NUM_EPISODES = 128


@dataclass(frozen=True)
class Task:
    """What brax trains."""

    body: str
    sizes: Published
    updates: int  # of one stretch
    stretches: int  # with an evaluation after each

    @property
    def steps(self) -> int:
        """Control steps of the whole training."""
        return self.stretches * self.updates * self.sizes.samples


class Run(NamedTuple):
    """One training; brax's first evaluation is before it."""

    trainer: str
    body: str
    seed: int
    cold: bool  # the first of its process, with an empty cache
    steps: list[int]  # trained on at each evaluation
    seconds: list[float]  # from the start to the end of each evaluation
    returns: list[float]  # mean of each evaluation's episodes
    rates: list[float]  # steps per second of each stretch, its evaluation left out


def make_task(body: str, sizes: Published, steps: int, evaluations: int) -> Task:
    """Rounds the steps up, to stretches of whole updates, as brax does."""
    stretches = evaluations - 1
    return Task(body, sizes, -(-steps // (stretches * sizes.samples)), stretches)


def run_brax(task: Task, seed: int) -> Run:
    """Trains with brax, on its own physics."""
    importlib.import_module("brax.training.agents.ppo.train")
    begin = time.perf_counter()
    run = Run("brax", task.body, seed, False, [], [], [], [])

    def progress(steps: int, metrics: dict[str, Any]) -> None:
        run.steps.append(int(steps))
        run.seconds.append(time.perf_counter() - begin)
        run.returns.append(float(metrics["eval/episode_reward"]))
        if steps:
            run.rates.append(float(metrics["training/sps"]))

    sizes, updates = task.sizes, task.updates
    train_brax(task.body, "mjx", sizes, updates, task.stretches, progress, NUM_EPISODES, seed)
    return run


def write(path: str, runs: list[Run]) -> None:
    """Writes the runs made so far."""
    found = {"device": jax.devices()[0].device_kind, "runs": [run._asdict() for run in runs]}
    if path:
        Path(path).write_text(json.dumps(found, indent=1))


def train(options: argparse.Namespace) -> list[Run]:
    """Trains the seeds one after another, within the time limit."""
    runs: list[Run] = []
    begin = time.perf_counter()
    sizes = resize(BODIES[options.body], options.num_envs)
    task = make_task(options.body, sizes, options.steps, options.evaluations)
    empty = not any(Path(options.cache).iterdir())
    jax.config.update("jax_compilation_cache_dir", options.cache)
    jax.block_until_ready(jax.numpy.zeros(1))  # the device's own start is not the trainer's
    for seed in options.seeds:
        if time.perf_counter() - begin > options.time_limit:
            print(f"Time limit: seed {seed} and later ones are left out.", flush=True)
            break
        run = run_brax(task, seed)
        runs.append(run._replace(cold=empty and not runs))
        print(describe(runs[-1]), flush=True)
        write(options.json, runs)
    return runs


def describe(run: Run) -> str:
    """Returns a run as one line."""
    curve = ", ".join(f"{value:.0f}" for value in run.returns)
    rate = float(np.median(run.rates[2:] or run.rates[-1:]))  # brax compiles in the first two
    return (
        f"{run.trainer} {run.body} seed {run.seed}{' from cold' if run.cold else ''}: "
        f"{run.seconds[-1]:.1f} s, steady {rate:,.0f} steps/s, returns {curve}"
    )


def read(body: str, path: str) -> list[Run]:
    """Reads the runs of one body: what `--json` wrote of brax, or a run's folder, or several's."""
    if Path(path).is_file():
        runs = [Run(**run) for run in json.loads(Path(path).read_text())["runs"]]
        return [run for run in runs if run.body == body]
    records = [run_reader.read(folder) for folder in run_reader.find_runs([Path(path)])]
    return [of_record(record) for record in records if record.settings.get("env.name") == body]


def of_record(record: run_reader.RunRecord) -> Run:
    """Returns one of our runs; UserError if it was never evaluated."""
    steps, returns, seconds = map(list, evaluations(record))
    if not returns:
        raise UserError(f"{record.path} has no {METRIC} yet; a row of the table is of evaluations.")
    body = record.settings["env.name"]
    counts = [int(count) for count in steps]
    return Run("purerl", body, record.seed, False, counts, seconds, returns, [])


def table(runs: Sequence[Run]) -> str:
    """Formats one body's runs, a line a trainer; differences are to brax."""
    lines = [
        "| trainer | seeds | steps | seconds | return, IQM (least to greatest) | minus brax's |"
    ]
    lines.append("|---|---|---|---|---|---|")
    brax = np.array([run.returns[-1] for run in runs if run.trainer == "brax"])
    for trainer in sorted({run.trainer for run in runs}):
        own = [run for run in runs if run.trainer == trainer]
        last = np.array([run.returns[-1] for run in own])
        iqm = float(bootstrap.interquartile_mean(last))
        seconds = np.median([run.seconds[-1] for run in own])
        cells = (
            trainer,
            str(len(own)),
            f"{np.median([run.steps[-1] for run in own]) / 1e6:.1f} M",
            f"{seconds:.0f}",
            f"{iqm:.0f} ({last.min():.0f} to {last.max():.0f})",
            difference(last, brax if trainer != "brax" else np.array([])),
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def difference(values: np.ndarray, others: np.ndarray) -> str:
    """Formats IQM(values) - IQM(others) with its interval, where there are runs enough for one."""
    if not others.size:
        return ""
    both = bootstrap.interquartile_mean(values) - bootstrap.interquartile_mean(others)
    interval = bootstrap.difference_interval([values], [others])
    bounds = f" [{interval.low:.0f}, {interval.high:.0f}]" if interval else ", too few seeds"
    return f"{both:.0f}{bounds}"


def parse(arguments: list[str]) -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = parser.add_subparsers(dest="what", required=True)
    shown = kinds.add_parser("table", help="of brax's files and our runs").add_argument
    shown("body", choices=tuple(BODIES))
    shown("places", nargs="+", help="a file of --json, a run, or a folder of runs")
    add = kinds.add_parser("train", help="with brax").add_argument
    add("body", choices=tuple(BODIES))
    add("--steps", type=int, default=31_129_600, help="rounded up")
    add("--evaluations", type=int, default=6, help="with the first, before training")
    add("--seeds", type=int, nargs="+", default=[0])
    add("--time-limit", type=float, default=float("inf"), help="begin no run after it [s]")
    add("--num-envs", type=int, default=0, help="0: as published; less for a try")
    add("--cache", default="", help="compilation cache's folder; of its own unless given")
    add("--json", type=output_file, default="", help="also write the runs to this file")
    return parser.parse_args(arguments)


def main(arguments: list[str]) -> int:
    """Trains, or prints the table of what was trained."""
    options = parse(arguments)
    if options.what == "table":
        runs = [run for place in options.places for run in read(options.body, place)]
        if not runs:
            raise UserError(f"{', '.join(options.places)} has no run of {options.body}.")
        print(table(runs))
        return 0
    with tempfile.TemporaryDirectory() as folder:
        options.cache = options.cache or folder
        Path(options.cache).mkdir(parents=True, exist_ok=True)
        train(options)
    return 0


if __name__ == "__main__":
    leave(lambda: main(sys.argv[1:]))
