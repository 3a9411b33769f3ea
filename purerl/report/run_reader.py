"""Reads runs back from their folders: settings, metrics, and how far each run came."""

import glob
import hashlib
import os
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from purerl.core.errors import UserError
from purerl.machine.files import check_object
from purerl.runs.folder import MANIFEST, Folder, allowed_changes, read_run, runs_in
from purerl.runs.metrics_file import MAX_SKIPPED_IN_A_ROW, read_metrics

NUMBER = int | float | None
NOT_LEARNING = ("seed", "evaluation")  # settings that tell runs of one configuration apart


class RunRecord(NamedTuple):
    """One run's folder, read."""

    path: Path
    seed: int
    settings: dict[str, Any]  # "experiment", "ppo.learning_rate", ...; without NOT_LEARNING
    manifest: dict[str, Any]
    source: bytes  # of experiment.py
    lines: list[dict[str, Any]]  # of metrics.jsonl
    planned: int | None  # updates; None where this version cannot read the settings

    @property
    def identity(self) -> str:
        """The seed and all settings that the run's bits depend on, as text."""
        return repr((self.seed, sorted(self.settings.items(), key=str)))

    @property
    def code(self) -> str:
        """A short hash of the code, the model and the data, whatever their files are called."""
        parts = flatten({name: self.manifest.get(name) for name in ("source", "model", "arrays")})
        return hashlib.sha256(repr(sorted(map(str, parts.values()))).encode()).hexdigest()[:8]

    @property
    def status(self) -> str:
        """Tells how the run ended: "done", "failed" or "unfinished".

        It failed if it stopped before its end with numbers that were not finite.
        """
        last = self.lines[-1] if self.lines else {"update": 0}
        if self.planned is None or last["update"] >= self.planned:
            return "done"
        skipped = last.get("train/skipped_in_a_row") or 0
        # What is not finite stands as null in the file.
        names = ("loss", "parameter_norm", "reward")  # as `loop` asks them
        null = [last.get(f"train/{name}", 0.0) is None for name in names]
        return "failed" if skipped >= MAX_SKIPPED_IN_A_ROW or any(null) else "unfinished"

    def curve(self, metric: str) -> dict[int, float]:
        """Returns steps -> value wherever the metric was measured and finite."""
        found = {line["steps"]: line.get(metric) for line in self.lines}
        most = sys.float_info.max  # of a float; JSON's integers have no end
        return {n: float(v) for n, v in found.items() if v is not None and abs(v) <= most}


def read_runs(arguments: Sequence[Path], command: str) -> list[RunRecord]:
    """Reads the runs that arguments of a command mean, as `find_runs`.

    Where runs agree in all settings and not in their code, the code is one more setting of them.

    Raises:
      UserError: there are none, or one of them means no run.
    """
    if not arguments:
        raise UserError(f"Give the runs to {command}: python -m purerl.{command} RUN RUN ...")
    runs = [read(path) for path in find_runs(arguments)]
    codes = Counter(settings for settings, _ in {(repr(run.settings), run.code) for run in runs})
    several = [codes[repr(run.settings)] > 1 for run in runs]
    more = ({"code": run.code} if apart else {} for run, apart in zip(runs, several, strict=True))
    return [run._replace(settings=run.settings | x) for run, x in zip(runs, more, strict=True)]


def find_runs(arguments: Iterable[Path]) -> list[Path]:
    """Returns the runs' folders that the arguments mean, in order, each once.

    An argument is a run, a folder of runs (`runs/ant_run`, `runs`) or, if nothing has that name, a
    pattern of these (`'runs/ant_run/a*'`). UserError if one means no run.
    """
    found: list[Path] = []
    for argument in arguments:
        matches = [] if os.path.exists(argument) else sorted(map(Path, glob.glob(str(argument))))
        runs = [run for place in matches or [argument] for run in runs_in(place)]
        if not runs:
            kind = "holds no run" if argument.is_dir() else "is no run, folder of runs or pattern"
            raise UserError(f"{argument} {kind}: no config.json is there.")
        found += runs
    return list(dict.fromkeys(found))


def read(path: Path) -> RunRecord:
    """Reads one run's folder; executes nothing of it."""
    folder = read_run(path)
    config, file = folder.config, folder.metrics
    settings = check_object(f"{path}: settings", config["settings"], seed=int, ppo=dict)
    experiment = {"experiment": config["experiment"]}
    learning = {k: v for k, v in settings.items() if k not in NOT_LEARNING}
    return RunRecord(
        path=path,
        seed=settings["seed"],
        settings=experiment | flatten(learning) | experiment | _went_on(folder),
        manifest=folder.manifest,
        source=folder.code,
        lines=[_check_line(f"{file}, line {i}", x) for i, x in enumerate(read_metrics(file), 1)],
        planned=_planned_updates(settings["ppo"]),
    )


def _went_on(folder: Folder) -> dict[str, Any]:
    """Returns as a setting what was changed while a run was trained, {} if nothing was.

    A run that went on with other settings, or other code of its own, is not one that had them from
    the start. The library's code, versions and devices are conditions: `compare` names them.
    """
    of_training = ("settings.", "experiment.py", "source.")
    of_none = ("source.purerl.", *(f"settings.{name}" for name in NOT_LEARNING))
    found = []
    for change in allowed_changes(folder):
        where = f"{folder.path / MANIFEST}: allowed_changes"
        known = check_object(where, change, after_update=int, changes=list)
        lines = [str(line) for line in known["changes"]]
        told = [x for x in lines if x.startswith(of_training) and not x.startswith(of_none)]
        found += [f"{line} after update {known['after_update']}" for line in told]
    return {"went_on_with": "; ".join(found)} if found else {}


def _check_line(where: str, line: dict[str, Any]) -> dict[str, Any]:
    """Returns a line of metrics.jsonl; UserError unless it holds numbers, and maybe a digest."""
    kinds = dict.fromkeys(line, NUMBER) | {"update": int, "steps": int}
    check_object(where, line, **(kinds | {"digest": str} if "digest" in line else kinds))
    for name in ("update", "steps"):
        if not 0 <= line[name] <= sys.maxsize:
            raise UserError(f"{where}: {name} is {line[name]}; it must be from 0 to {sys.maxsize}.")
    return line


def flatten(value: Any, path: str = "") -> dict[str, Any]:
    """Returns nested settings as {"a.b": value}; lists stay whole."""
    if not isinstance(value, dict):
        return {path: value}
    inner = [flatten(v, f"{path}.{k}" if path else k) for k, v in value.items()]
    return {k: v for part in inner for k, v in part.items()}


def _planned_updates(ppo: dict[str, Any]) -> int | None:
    """Returns the updates of the whole run; settings that this version lacks do not matter."""
    try:
        return ppo["num_steps"] // (ppo["num_envs"] * ppo["rollout_length"])
    except (TypeError, LookupError, ArithmeticError):  # the settings of another version
        return None
