"""Trains control suite tasks by seeds, and scores them beside what others published.

    python -m purerl.experiments.benchmarks.suite_benchmark # every task: hours
    python -m purerl.experiments.benchmarks.suite_benchmark cheetah-run hopper-hop --steps 3000000
    python -m purerl.experiments.benchmarks.suite_benchmark --gpu --engine warp # on a GPU
    python -m purerl.experiments.benchmarks.suite_benchmark --scores a.csv runs/suite # no training

Other words are settings, as `python -m purerl.run suite --help` lists them. All seeds of a task
are vmapped in one process, as many processes at once as the machine takes. The same command goes
on with what was stopped; a seed that fails is counted as failed. It is a sweep over `env.task`, and
its folder is one of `python -m purerl.sweep`; the humanoids, with settings of their own, are a
second one. What several machines have trained becomes one table by `--scores`.
"""

import argparse
import csv
import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path

from purerl.core.errors import INTERRUPTED, SUCCESS, USAGE, UserError, unknown_name
from purerl.envs.suite.tasks import TASKS
from purerl.experiments.benchmarks import suite_clock, suite_pictures, suite_scores
from purerl.machine.command_errors import leave
from purerl.report.run_reader import read
from purerl.runs.folder import runs_in
from purerl.sweep import main as sweep


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code, which is that of the sweep."""
    parser = argparse.ArgumentParser(
        prog="python -m purerl.experiments.benchmarks.suite_benchmark",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        exit_on_error=False,  # it would print all options
    )
    parser.add_argument("tasks", nargs="*", help="which tasks; all by default")
    parser.add_argument(
        "--steps", type=int, help="control steps of each run; by default the experiment's own"
    )
    parser.add_argument(
        "--gpu",
        action="store_true",
        help="train with suite_gpu instead of suite; not the humanoids",
    )
    parser.add_argument("--seeds", type=int, default=5, help="seeds of each task")
    parser.add_argument("--first-seed", type=int, default=20, help="others than those chosen on")
    parser.add_argument("--jobs", type=int, default=0, help="processes at once; 0: by the machine")
    parser.add_argument("--name", default="suite", help="of the sweep, a folder in sweeps/")
    parser.add_argument(
        "--out",
        type=Path,
        help="folder for tables and pictures; the sweep's own, or here for --scores",
    )
    parser.add_argument(
        "--scores",
        type=Path,
        nargs="+",
        metavar="PATH",
        help="train nothing: score these files seeds.csv, and folders of runs",
    )
    try:
        options, settings = parser.parse_known_args(arguments)
    except argparse.ArgumentError as error:
        raise UserError(f"{error}. All options: {parser.prog} --help") from error
    if options.scores is not None:
        sources = [given(place) for place in options.scores]
        seeds = suite_scores.merged(sources)
        if left_out := sum(map(len, sources)) - len(seeds):
            print(f"left out, as another run of the task and seed is longer: {left_out}")
        report(seeds, options.out or Path("."))
        return SUCCESS
    for task in options.tasks:
        if task not in TASKS:
            raise UserError(unknown_name("task", task, TASKS))
    return train(options, settings)


def train(options: argparse.Namespace, settings: Sequence[str]) -> int:
    """Carries out a sweep for each experiment that has some of the tasks, and scores all runs."""
    folders: list[Path] = []
    code = SUCCESS
    for experiment, tasks in by_experiment(options.tasks or TASKS, options.gpu).items():
        name = options.name + experiment.removeprefix("suite")
        last = sweep(words(options, experiment, tasks, name, settings))
        if last == USAGE:
            return last
        folders.append(Path("sweeps") / name / experiment)
        code = max(code, last)
        if last == INTERRUPTED:
            break
    seeds = [s for folder in folders if folder.is_dir() for s in scored(folder)]
    if code != INTERRUPTED:
        seeds += never_begun(options, seeds)
    report(seeds, options.out or folders[0].parent)
    return code


def by_experiment(tasks: Iterable[str], gpu: bool) -> dict[str, list[str]]:
    """Returns experiment -> those of the tasks that are trained with its settings."""
    others = "suite_gpu" if gpu else "suite"
    found: dict[str, list[str]] = {}
    for task in tasks:
        name = "suite_humanoid" if task.startswith("humanoid-") else others
        found.setdefault(name, []).append(task)
    return found


def scored(place: Path) -> list[suite_scores.Seed]:
    """Returns the seeds of a file that `report` wrote, or of the suite's runs in a folder."""
    if place.is_file():
        return suite_scores.read_seeds(place)
    runs = map(read, runs_in(place))
    return [suite_scores.seed_of(run) for run in runs if "env.task" in run.settings]


def given(place: Path) -> list[suite_scores.Seed]:
    """Returns what `scored` does; UserError if that is nothing, as of a mistyped folder."""
    if not place.exists():
        raise UserError(f"There is no {place}: give a seeds.csv, or a folder of runs.")
    if seeds := scored(place):
        return seeds
    raise UserError(
        f"{place} has no seed of the control suite: give a seeds.csv, or a folder of runs, "
        "each of which has a config.json with env.task."
    )


def never_begun(
    options: argparse.Namespace, seeds: Iterable[suite_scores.Seed]
) -> list[suite_scores.Seed]:
    """Returns the seeds that failed before they had a folder: they count, too."""
    known = {(s.task, s.seed) for s in seeds}
    numbers = range(options.first_seed, options.first_seed + options.seeds)
    every = itertools.product(options.tasks or TASKS, numbers)
    return [suite_scores.Seed(*one, "failed", (), (), ()) for one in every if one not in known]


def words(
    options: argparse.Namespace,
    experiment: str,
    tasks: Sequence[str],
    name: str,
    settings: Sequence[str],
) -> list[str]:
    """Returns a sweep's command line: a point for each task, a run for each seed."""
    return [
        experiment,
        *("--grid", f"env.task={','.join(tasks)}"),
        *("--seeds", str(options.seeds), "--seed", str(options.first_seed)),
        *(("--ppo.num-steps", str(options.steps)) if options.steps is not None else ()),
        *("--evaluation.number", "20"),
        *("--jobs", str(options.jobs), "--name", name),
        *settings,
    ]


def report(seeds: Sequence[suite_scores.Seed], out: Path) -> None:
    """Writes seeds.csv, tasks.csv, clock.csv and the pictures, and prints what is ahead of whom."""
    tasks, published = suite_scores.by_task(seeds), suite_scores.references()
    by_time = suite_clock.references()
    if not tasks:
        print("No seed has come to its end yet.")
        return
    out.mkdir(parents=True, exist_ok=True)
    suite_scores.write_seeds(out / "seeds.csv", seeds)
    rows = suite_scores.table(tasks, published)
    _write(out / "tasks.csv", rows)
    _write(out / "clock.csv", suite_clock.table(tasks, by_time))
    for row in rows:
        print(" ".join([f"{row[0]:24}", *(f"{cell!s:>12}" for cell in row[1:])]))
    print(suite_pictures.summary(tasks))
    for column in suite_scores.SHOWN:
        print(suite_scores.told(column, *suite_scores.ahead(tasks, published, column)))
    print(*suite_clock.verdicts(tasks, by_time), sep="\n")
    suite_pictures.draw_tasks(out / "tasks_over_steps.png", tasks, published, {}, "steps")
    suite_pictures.draw_tasks(out / "tasks_over_seconds.png", tasks, {}, by_time, "seconds")
    suite_pictures.draw_together(out / "together.png", tasks)
    print(*(str(path) for path in sorted(out.glob("t*.png"))), sep="\n")


def _write(path: Path, rows: Iterable[Sequence[object]]) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


if __name__ == "__main__":
    leave(main)
