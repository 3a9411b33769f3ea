"""Carries a sweep out: its folder, its runs, its table."""

import contextlib
import hashlib
import itertools
import shlex
from collections.abc import Container, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from purerl.core.errors import FAILURE, INTERRUPTED, SUCCESS, UserError, some
from purerl.experiment.loading import Source
from purerl.experiment.settings_json import to_json
from purerl.experiment.source_hashes import PACKAGE, source_hashes
from purerl.machine import command_errors, files
from purerl.machine.lock import FolderLock
from purerl.machine.output import say, show, warn
from purerl.report.seed_statistics import check_metric, summarize
from purerl.runs import folder as run_folder, manifest
from purerl.tune.sweep import points, scheduler, slurm, spaces, study, table
from purerl.tune.sweep.options import SweepOptions, read as read_command
from purerl.tune.sweep.points import Base, Point
from purerl.tune.sweep.spaces import Space


class Sweep(NamedTuple):
    """A sweep that has been checked."""

    options: SweepOptions
    base: Base
    spaces: list[Space]
    points: list[Point]  # empty if Optuna chooses them


def execute(arguments: Sequence[str]) -> int:
    """Checks the whole command, then carries it out; returns the exit code."""
    options, base, given = read_command(arguments)
    # An option without any SETTING=VALUES is a text without any.
    texts = [text for texts in options.grid or options.over for text in texts or ("",)]
    swept = points.read_spaces(base, texts, given)
    points.check_evaluated(base, swept, options.metric)
    sweep = Sweep(options, base, swept, [])
    if options.optuna:
        spaces.check_number("optuna", options.optuna)
        command_errors.check_installed("optuna", "sweep")
    else:
        drawn = spaces.draw(swept, options.random) if options.random else spaces.grid(swept)
        sweep.points.extend(Point(number, values) for number, values in enumerate(drawn))
        points.check_all(base, sweep.points)
    if options.slurm:
        command_errors.check_installed("submitit", "sweep")
        slurm.check(options.slurm, base.folder)
    if options.dry_run:
        return _show_commands(sweep)
    with _begin(sweep), study.kept(base.folder):
        return _submit(sweep) if options.slurm else _carry_out(sweep)


def _show_commands(sweep: Sweep) -> int:
    shown = sweep.points
    if sweep.options.optuna:
        first = study.propose(study.open_study(None), sweep.spaces, sweep.options.optuna)
        shown = list(itertools.islice(first, study.FIRST))
    for point in shown:
        show(shlex.join(["python", "-m", "purerl.run", *points.job(sweep.base, point).words]))
    if sweep.options.optuna > len(shown):
        show(f"# The other {sweep.options.optuna - len(shown)} points depend on scores.")
    return SUCCESS


# --- the folder ---


@contextlib.contextmanager
def _begin(sweep: Sweep) -> Iterator[None]:
    """Makes the sweep's folder and locks it; UserError if it holds another sweep."""
    folder = sweep.base.folder
    file = folder / "sweep.json"
    with files.writing(folder):
        files.make_folder(folder)
        run_folder.check_no_links(run_folder.read(folder))
        if not file.exists() and any(not one.name.startswith(".") for one in folder.iterdir()):
            raise UserError(f"{folder} holds no sweep, but other files; use another --name.")
        held = f"The sweep {folder} is being carried out by another process"
        lock = FolderLock(folder, held=held)
    with contextlib.closing(lock):
        described = _describe(sweep)
        if file.exists():
            # An older version wrote less down, and goes on.
            begun = files.check_object(str(file), described | files.read_json(file), source=dict)
            _check_same(folder, begun, described)
            _check_code(sweep.base, begun["source"], described["source"])
        files.write_json(file, described)
        yield


def _check_same(folder: Path, begun: dict[str, Any], now: dict[str, Any]) -> None:
    """Raises UserError unless both describe one sweep; its code is looked at by itself."""
    found = manifest.differences(begun | {"source": now["source"]}, now)
    if found:
        raise UserError(
            f"The sweep {folder} was begun otherwise: {some(found, 1)}; give the command it was "
            "begun with, or another --name."
        )


def _check_code(base: Base, begun: dict[str, Any], now: dict[str, str]) -> None:
    """Raises UserError if a run has begun with other code of the experiment than it has now.

    A file that is new, or no longer imported, is so by a change of one that is in both.
    """
    changed = [name for name in begun if now.get(name, begun[name]) != begun[name]]
    if not changed or base.options.allow_changes:
        return
    runs = (base.folder / base.source.name).glob("*")
    if any(run_folder.read(run).is_begun for run in runs):
        raise UserError(
            f"The experiment's code has changed since the sweep {base.folder} began: "
            f"{some(changed, 1)}; put it back, use another --name, or go on all the same with "
            "--allow-changes."
        )


def _code(source: Source) -> dict[str, str]:
    """Returns hashes of the experiment's code: its file, and by module what it imports.

    The library's own is a condition, as versions are: `compare` names them.
    """
    own = hashlib.sha256(source.text).hexdigest()[:16]
    found = source_hashes((source.experiment.build_env, source.experiment.build_network))
    own_too = {name for name, digest in found.items() if digest == own}
    library = {name for name in found if name.partition(".")[0] == PACKAGE.name}
    others = {name: found[name] for name in found.keys() - own_too - library}
    return {source.path.name: own} | dict(sorted(others.items()))


def _describe(sweep: Sweep) -> dict[str, Any]:
    """Returns what makes a sweep another one; of drawn points their number does not."""
    options, base = sweep.options, sweep.base
    swept = {}
    for space in sweep.spaces:
        # Choices as they are read: `1e-4` is `0.0001`.
        values = [to_json(points.read_value(base, space.setting, text)) for text in space.choices]
        ends = {"low": space.low, "high": space.high, "log": space.log}
        swept[space.setting] = values or ends
    how = "random" if options.random else "optuna" if options.optuna else "grid"
    found = {"experiment": base.source.name, "settings": to_json(base.chosen), "swept": swept}
    found |= {"points": how, "seeds": options.seeds}
    # Options of the runs that alter their bits, or the steps that a line of metrics is about.
    found |= {n: getattr(base.options, n) for n in ("portable", "num_shards", "log_every")}
    found |= {"seeds_by": base.options.seeds_by} if options.seeds > 1 else {}
    found |= {"source": _code(base.source)}
    return found | ({"metric": options.metric} if options.optuna else {})


# --- carrying out ---


class _Progress:
    """Tells of each job, and tells Optuna its score."""

    def __init__(self, sweep: Sweep) -> None:
        self.sweep = sweep
        self.number = sweep.options.optuna or len(sweep.points)
        self.study = study.open_study(sweep.base.folder) if sweep.options.optuna else None
        known = study.known(self.study, sweep.spaces) if self.study else sweep.points
        self.points = {point.name: point for point in known}
        self.results: list[scheduler.Ended] = []
        self.begun: set[str] = set()  # by this command

    def jobs(self) -> Iterator[scheduler.Job]:
        """Yields what is to be run; Optuna chooses when it is asked for."""
        chosen: Iterator[Point] = iter(self.sweep.points)
        if self.study is not None:
            chosen = study.propose(self.study, self.sweep.spaces, self.sweep.options.optuna)
        for point in chosen:
            self.points[point.name] = point
            yield points.job(self.sweep.base, point)

    def began(self, job: scheduler.Job) -> None:
        self.begun.add(job.name)
        say(f"{job.name}  begins   {self._values(job)}  (progress: {job.log})")

    def ended(self, result: scheduler.Ended) -> None:
        """Tells how a job ended; UserError if it is done, and no run so far has such a metric.

        That is told once of a point, so that the same command goes on; at the end in any case.
        """
        self.results.append(result)
        point, metric, score = self.points[result.job.name], self.sweep.options.metric, None
        if result.status == "done":
            score = summarize(table.group_of(self.sweep.base, point), metric)["score"]
            told_now = point.name in self.begun or len(self.results) == self.number
            if score is None and told_now:
                groups = [table.group_of(self.sweep.base, one) for one in self.points.values()]
                check_metric([run for group in groups for run in group.runs], metric)
        if self.study is not None and score is not None:
            study.tell(self.study, point, score)
        shown = f": {result.said}" if score is None and result.said else ""
        shown = f": {score:.6g}" if score is not None else shown
        count = f"{len(self.results)} of {self.number}"
        say(f"{point.name}  {result.status:8} {self._values(result.job)}{shown}  ({count})")

    def _values(self, job: scheduler.Job) -> str:
        return " ".join(f"{n}={v}" for n, v in self.points[job.name].values.items())


def _carry_out(sweep: Sweep) -> int:
    """Runs all points here, then makes the table; returns the exit code."""
    gpus = scheduler.find_gpus()
    at_once = sweep.options.jobs or scheduler.jobs_at_once(gpus)
    progress = _Progress(sweep)
    place = f"{len(gpus)} GPUs" if gpus else "the CPU"
    say(f"sweep        {sweep.base.folder}: {progress.number} points of {sweep.base.seeds} seeds, "
        f"{at_once} at once on {place}")  # fmt: skip
    asked = scheduler.carry_out(progress.jobs(), at_once, gpus, progress.began, progress.ended)
    status = {row.status for row in _report(sweep, list(progress.points.values()))}
    if asked or status & {"stopped", "training", "waiting"}:
        warn("Stopped; the same command goes on.")
        return INTERRUPTED
    return FAILURE if "failed" in status else SUCCESS


def _submit(sweep: Sweep) -> int:
    """Submits what is not done to SLURM, and makes the table of what there is."""
    jobs = [points.job(sweep.base, point) for point in sweep.points]
    options = sweep.options
    names, queued = slurm.submit(jobs, sweep.base.folder, options.slurm, options.jobs)
    say(f"sweep        {sweep.base.folder}: {len(names)} of {len(jobs)} points submitted, "
        f"{len(queued)} in the queue or training")  # fmt: skip
    if names or queued:
        say("The same command tells how far they are, and submits again what was stopped.")
    rows = _report(sweep, sweep.points, {*names, *queued})
    return FAILURE if "failed" in {row.status for row in rows} else SUCCESS


def _report(sweep: Sweep, chosen: Sequence[Point], queued: Container[str] = ()) -> list[table.Row]:
    """Prints the table, and writes it and the picture; returns its rows."""
    metric, folder = sweep.options.metric, sweep.base.folder
    rows = table.make_rows(sweep.base, chosen, metric, queued)
    lines = table.describe(rows, sweep.spaces, metric)
    show(*lines, *map(str, table.write(folder, rows, sweep.spaces, metric, lines)))
    return rows
