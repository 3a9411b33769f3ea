"""What the planner returns on tasks, without learning: a row of a CSV file for each episode.

    nice -n 15 python -m experiments.benchmarks.plan_suite --out plan_suite.csv
    python -m experiments.benchmarks.plan_suite --only hopper-hop --planners cem --steps 200

Ended at any moment, the same command goes on: batches that the file has are not played again. The
table of means with 95% intervals is printed at the end, and by --table alone.
"""

import argparse
import csv
import dataclasses
import itertools
import time
from pathlib import Path

import numpy as np

from envs.suite.tasks import TASKS, Options as SuiteOptions
from experiments.benchmarks.output import output_file
from purerl.devices.compilation import set_up_jax
from purerl.plan import episodes, planner
from purerl.plan.figures import said
from purerl.plan.settings import Settings
from purerl.runs.build_experiment import build
from purerl.runs.command_errors import leave
from purerl.runs.experiment import Experiment, available, find

MUST_SHOW = ("cartpole-swingup", "walker-walk", "cheetah-run", "hopper-hop", "humanoid-stand")
PLANNERS = ("predictive_sampling", "mppi", "cem")
FIGURES = ("return", "length", "lost", "plans_per_s")
COLUMNS = ("task", "planner", "steps", "seed", "episode", *FIGURES)


def experiment_of(task: str) -> Experiment:
    """Returns an experiment by name, or a task of the suite."""
    if task not in TASKS:
        return find(task)
    return dataclasses.replace(find("suite"), env=SuiteOptions(task=task))


def play(task: str, settings: Settings, steps: int, seed: int, number: int) -> list[dict]:
    """Plays a batch of episodes; returns a row for each."""
    config, env, _, _ = build(experiment_of(task))
    limit = steps or config.episode_length
    config = dataclasses.replace(config, episode_length=limit)
    guide = planner.unguided(env.action_size)
    game = episodes.episodes(config, settings, env, lambda _: guide, (), seed, number)
    times = []
    for playing, _ in game:
        end = playing
        times.append(time.perf_counter())
    # The first call was compiling.
    rate = (len(times) - 1) * episodes.CHUNK * number / max(times[-1] - times[0], 1e-9)
    found = episodes.results(end)
    about = {"task": task, "planner": settings.planner, "steps": limit, "seed": seed}
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
    """Returns the rows that a file has so far."""
    return list(csv.DictReader(file.open())) if file.exists() else []


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
        "experiments.benchmarks.plan_suite", description=__doc__, formatter_class=plain
    )
    default = [*MUST_SHOW, "ant_gaps"]
    known = [*TASKS, *(set(available()) - {"suite"})]
    parser.add_argument("--out", type=output_file, default="plan_suite.csv")
    parser.add_argument("--only", nargs="+", default=default, choices=known, metavar="TASK")
    parser.add_argument("--planners", nargs="+", default=PLANNERS, choices=PLANNERS)
    parser.add_argument("--batches", type=int, default=5, help="each of a seed of its own")
    parser.add_argument("--side-by-side", type=int, default=2, help="episodes of a batch")
    parser.add_argument("--steps", type=int, default=0, help="0: the experiment's time limit")
    parser.add_argument("--table", action="store_true", help="play nothing")
    options = parser.parse_args()
    set_up_jax(cache=True)
    file = Path(options.out)
    games = itertools.product(range(options.batches), options.only, options.planners)
    for seed, task, name in () if options.table else games:
        limit = options.steps or experiment_of(task).ppo.episode_length
        done = [(r["task"], r["planner"], int(r["steps"]), int(r["seed"])) for r in read(file)]
        if (task, name, limit, seed) in done:
            continue
        rows = play(task, Settings(name), options.steps, seed, options.side_by_side)
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
