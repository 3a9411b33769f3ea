"""What the planner returns on tasks, without learning: a row of a CSV file for each episode.

    nice -n 15 python -m purerl.experiments.benchmarks.plan_suite --out plan_suite.csv
    python -m purerl.experiments.benchmarks.plan_suite --only hopper-hop --planners cem --steps 200
    python -m purerl.experiments.benchmarks.plan_suite --runs runs/suite/hopper-hop --out beside.csv

Of a run there are rows for its policy alone ("policy"), for planners without it, and for planners
that correct it ("mppi+policy"), on the same beginnings. What the last ones find beyond the policy,
it has left on the table.

Ended at any moment, the same command goes on: batches that the file has are not played again. The
table of means with 95% intervals is printed at the end, and by --table alone.
"""

import argparse
import csv
import dataclasses
import functools
import itertools
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from purerl.core.errors import UserError
from purerl.devices.compilation import set_up_jax
from purerl.envs.suite.tasks import TASKS, Options as SuiteOptions
from purerl.experiment.definition import Experiment
from purerl.experiment.loading import available, find
from purerl.experiment.objects import build
from purerl.experiments.benchmarks.output import count, output_file
from purerl.machine.command_errors import leave
from purerl.runs.loaded_run import load
from purerl.tune.plan import episodes, planner
from purerl.tune.plan.figures import said
from purerl.tune.plan.settings import NO_SEARCH, Settings

MUST_SHOW = ("cartpole-swingup", "walker-walk", "cheetah-run", "hopper-hop", "humanoid-stand")
# The cart hits its end 2 s after what set it on its way there; the control step is 10 ms.
# A lying hopper earns 0 whatever it does, until a wild movement has thrown it up.
OTHER_SETTINGS: dict[str, dict[str, Any]] = {
    "cartpole-swingup": {"samples": 32, "horizon": 150},
    "hopper-hop": {"noise": 1.0},
}
PLANNERS = ("predictive_sampling", "mppi", "cem")
FIGURES = ("return", "length", "lost", "plans_per_s")
COLUMNS = ("task", "planner", "steps", "seed", "episode", *FIGURES)
READ = {"task", "planner", "steps", "seed", "return"}  # what a file must have to be gone on with


def experiment_of(task: str) -> Experiment:
    """Returns an experiment by name, or a task of the suite."""
    if task not in TASKS:
        return find(task)
    return dataclasses.replace(find("suite"), env=SuiteOptions(task=task))


def limit_of(task: str) -> int:
    """Returns the time limit of a task, or of a run's folder [control steps]."""
    known = load(task).experiment if Path(task).is_dir() else experiment_of(task)
    return known.ppo.episode_length


def settings_of(task: str, name: str) -> Settings:
    """Returns a planner's settings for a task by its name, with "+policy" or without."""
    if name == "policy":
        return Settings(**NO_SEARCH)
    kind: Any = name.removesuffix("+policy")
    return dataclasses.replace(Settings(kind), **OTHER_SETTINGS.get(task, {}))


def play(task: str, name: str, steps: int, seed: int, number: int) -> list[dict]:
    """Plays a batch of episodes of a task, or of a run's folder; returns a row for each."""
    run = load(task) if Path(task).is_dir() else None
    config, env, network, _ = run.restored.setup if run else build(experiment_of(task))
    limit = steps or config.episode_length
    config = dataclasses.replace(config, episode_length=limit)

    guide = functools.partial(planner.guide_of, config, env, network)
    learned = run.state if run and name.endswith("policy") else None
    game = episodes.episodes(config, settings_of(task, name), env, guide, learned, seed, number)
    times = []
    for playing, rows in game:
        end, _ = jax.block_until_ready((playing, rows))
        times.append(time.perf_counter())
    # The first call was compiling.
    rate = (len(times) - 1) * episodes.CHUNK * number / max(times[-1] - times[0], 1e-9)
    found = episodes.results(end)
    about = {"task": task, "planner": name, "steps": limit, "seed": seed}
    return [
        about
        | {
            "episode": i,
            "return": found["episode_return"][i],
            "length": int(found["episode_length"][i]),
            "lost": int(found["lost"][i]),
            "plans_per_s": round(float(rate), 2),
        }
        for i in range(number)
    ]


def read(file: Path) -> list[dict[str, str]]:
    """Returns the rows that a file has so far; UserError if it is another's."""
    if not file.exists():
        return []
    with file.open(newline="") as opened:
        rows = csv.DictReader(opened)
        if missing := READ - set(rows.fieldnames or ()):
            raise UserError(f"{file} has no column {min(missing)}: name another file with --out.")
        return list(rows)


def table(rows: list[dict[str, str]]) -> list[str]:
    """Returns lines with what the planners returned, by task and steps."""
    groups: dict[tuple[str, ...], list[float]] = {}
    for row in rows:
        name = (row["task"], row["steps"], row["planner"])
        groups.setdefault(name, []).append(float(row["return"]))
    return [
        f"{task:18} {steps:>5} steps  {name:20} N = {len(values):<3} {said(np.array(values))}"
        for (task, steps, name), values in groups.items()
    ]


def main() -> int:
    """Plays what is missing, and prints the table."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        "purerl.experiments.benchmarks.plan_suite", description=__doc__, formatter_class=plain
    )
    default = [*MUST_SHOW, "ant_gaps"]
    known = [*TASKS, *(set(available()) - {"suite"})]
    parser.add_argument("--out", type=output_file, default="plan_suite.csv")
    parser.add_argument("--only", nargs="+", default=default, choices=known, metavar="TASK")
    parser.add_argument("--planners", nargs="+", default=PLANNERS, choices=PLANNERS)
    parser.add_argument("--runs", nargs="+", default=[], help="runs' folders, instead of tasks")
    parser.add_argument("--batches", type=count, default=5, help="each of a seed of its own")
    parser.add_argument("--side-by-side", type=count, default=2, help="episodes of a batch")
    parser.add_argument("--steps", type=int, default=0, help="0: the experiment's time limit")
    parser.add_argument("--table", action="store_true", help="play nothing")
    options = parser.parse_args()
    set_up_jax(cache=True)
    file = Path(options.out)
    names = options.planners
    if options.runs:
        names = ["policy", *names, *(f"{name}+policy" for name in names)]
    games = itertools.product(range(options.batches), options.runs or options.only, names)
    for seed, task, name in () if options.table else games:
        limit = options.steps or limit_of(task)
        done = [(r["task"], r["planner"], int(r["steps"]), int(r["seed"])) for r in read(file)]
        if (task, name, limit, seed) in done:
            continue
        rows = play(task, name, options.steps, seed, options.side_by_side)
        is_new = not file.exists()
        with file.open("a", newline="") as out:
            writer = csv.DictWriter(out, COLUMNS)
            if is_new:
                writer.writeheader()
            writer.writerows(rows)
        print(*(f"{task} {name} {r['return']:.1f}" for r in rows), flush=True)
    print(*table(read(file)), sep="\n")
    return 0


if __name__ == "__main__":
    leave(main)
