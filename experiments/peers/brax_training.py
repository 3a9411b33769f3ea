"""brax's PPO beside ours: the whole training from cold, and the returns of several seeds.

    python -m experiments.peers.brax_training brax ant --seeds 0 1 2 3 4 --json brax_ant.json
    python -m experiments.peers.brax_training purerl ant --seeds 0 1 2 3 4 --json purerl_ant.json
    python -m experiments.peers.brax_training table brax_ant.json purerl_ant.json

Settings are those of `experiments/peers/brax_peer.py`. One process trains with one trainer, so that
neither finds the machine warmed by the other, and brax keeps XLA's own choice of kernels. With
`purerl on brax's physics` and `purerl` it is the first or the third line of that table.

The first seed is from cold: an empty compilation cache (of its own folder, unless `--cache` names
one), building and compiling included, importing not. Later seeds find what it compiled. Evaluations
are of 128 episodes of the deterministic policy, the first one before training, as brax counts them.
No run is begun after the time limit, and the file is written after every run.
"""

import argparse
import functools
import importlib
import json
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.benchmarks.output import output_file
from experiments.peers.brax_peer import BODIES, Published, our_experiment, resize, train_brax
from purerl import exact
from purerl.core.errors import UserError
from purerl.devices.programs import Programs, compile_programs
from purerl.devices.shards import Shards
from purerl.ppo.config import Evaluation
from purerl.report import bootstrap
from purerl.runs import build_experiment
from purerl.runs.command_errors import leave

NUM_EPISODES = 128
PHYSICS = {"purerl": "purerl", "purerl-on-brax": "mjx"}  # ours -> whose
TRAINERS = ("brax", *PHYSICS)


@dataclass(frozen=True)
class Task:
    """What is trained, with whatever trainer."""

    body: str
    sizes: Published
    updates: int  # of one stretch
    stretches: int  # with an evaluation after each

    @property
    def steps(self) -> int:
        """Control steps of the whole training."""
        return self.stretches * self.updates * self.sizes.samples


class Run(NamedTuple):
    """One training; the first evaluation is before it."""

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


@functools.cache
def our_programs(task: Task, physics: str) -> Programs:
    """Compiles our training, once in a process."""
    chosen = our_experiment(task.body, physics, task.sizes, task.steps)
    config, env, network, _ = build_experiment.build(chosen)
    evaluation = Evaluation(num_episodes=NUM_EPISODES)
    return compile_programs(config, env, network, evaluation, True, Shards())


def run_ours(task: Task, trainer: str, seed: int) -> Run:
    """Trains with our programs, called as `purerl.runs.loop` calls them."""
    for name in ("brax.envs", "purerl.physics.engine_mjx"):
        importlib.import_module(name)
    begin = time.perf_counter()
    run = Run(trainer, task.body, seed, False, [], [], [], [])
    programs = our_programs(task, PHYSICS[trainer])
    state = programs.init(jax.random.key(seed))
    for stretch in range(task.stretches + 1):
        if stretch:
            start = time.perf_counter()
            for _ in range(task.updates):
                state, metrics = programs.update(state)
            jax.device_get(metrics)
            samples = task.updates * task.sizes.samples
            run.rates.append(samples / (time.perf_counter() - start))
        judged = jax.device_get(programs.evaluate(state))
        run.steps.append(stretch * task.updates * task.sizes.samples)
        run.seconds.append(time.perf_counter() - begin)
        run.returns.append(float(np.mean(judged["episode_return"])))
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
    jax.block_until_ready(jax.numpy.zeros(1))  # the device's own start is neither trainer's
    for seed in options.seeds:
        if time.perf_counter() - begin > options.time_limit:
            print(f"Time limit: seed {seed} and later ones are left out.", flush=True)
            break
        run = run_brax(task, seed) if options.what == "brax" else run_ours(task, options.what, seed)
        runs.append(run._replace(cold=empty and not runs))
        print(describe(runs[-1]), flush=True)
        write(options.json, runs)
    return runs


def describe(run: Run) -> str:
    """Returns a run as one line."""
    curve = ", ".join(f"{value:.0f}" for value in run.returns)
    return (
        f"{run.trainer} {run.body} seed {run.seed}{' from cold' if run.cold else ''}: "
        f"{run.seconds[-1]:.1f} s, steady {steady([run]):,.0f} steps/s, returns {curve}"
    )


def steady(runs: list[Run]) -> float:
    """Returns the median rate of the stretches after the first two, in which brax compiles."""
    rates = [rate for run in runs for rate in run.rates[2:] or run.rates[-1:]]
    return float(np.median(rates))


def table(runs: list[Run]) -> str:
    """Formats one body's runs, a line a trainer; differences are to brax."""
    lines = [
        "| trainer | from cold [s] | steady steps/s | seeds | final return, IQM | minus brax's |"
    ]
    lines.append("|---|---|---|---|---|---|")
    final = {
        trainer: np.array([run.returns[-1] for run in runs if run.trainer == trainer])
        for trainer in TRAINERS
    }
    for trainer, values in final.items():
        own = [run for run in runs if run.trainer == trainer]
        if not own:
            continue
        cold = ", ".join(f"{run.seconds[-1]:.1f}" for run in own if run.cold) or "not measured"
        iqm = float(bootstrap.interquartile_mean(values))
        other = final["brax"] if trainer != "brax" else np.array([])
        cells = (trainer, cold, f"{steady(own):,.0f}", str(len(own)), f"{iqm:.0f}")
        lines.append(f"| {' | '.join((*cells, difference(values, other)))} |")
    return "\n".join(lines)


def difference(values: np.ndarray, others: np.ndarray) -> str:
    """Formats IQM(values) - IQM(others) with its interval, where there are runs enough for one."""
    if not others.size:
        return ""
    both = bootstrap.interquartile_mean(values) - bootstrap.interquartile_mean(others)
    interval = bootstrap.difference_interval([values], [others])
    bounds = f" [{interval.low:.0f}, {interval.high:.0f}]" if interval else ", too few seeds"
    return f"{both:.0f}{bounds}"


def read(paths: list[str]) -> list[Run]:
    """Reads the runs of several files."""
    missing = [path for path in paths if not Path(path).is_file()]
    if missing:
        raise UserError(
            f"There is no file {', '.join(missing)}; `--json` of a training writes one."
        )
    return [Run(**run) for path in paths for run in json.loads(Path(path).read_text())["runs"]]


def parse(arguments: list[str]) -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = parser.add_subparsers(dest="what", required=True)
    kinds.add_parser("table", help="of written files").add_argument("files", nargs="+")
    for trainer in TRAINERS:
        add = kinds.add_parser(trainer, help="train").add_argument
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
        runs = read(options.files)
        for body in sorted({run.body for run in runs}):
            print(f"{body}\n\n{table([run for run in runs if run.body == body])}\n")
        return 0
    if options.what != "brax":
        exact.set_xla_flags()  # before JAX starts
    with tempfile.TemporaryDirectory() as folder:
        options.cache = options.cache or folder
        Path(options.cache).mkdir(parents=True, exist_ok=True)
        train(options)
    return 0


if __name__ == "__main__":
    leave(lambda: main(sys.argv[1:]))
