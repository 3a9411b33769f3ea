"""Reads runs back from their folders: settings, metrics, and how far each run came."""

import glob
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from purerl.core.errors import UserError, one_line
from purerl.ppo.config import Config
from purerl.runs.files import read_json, runs_in
from purerl.runs.loaded_run import read_metrics
from purerl.runs.loggers import MAX_SKIPPED_IN_A_ROW

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
    def status(self) -> str:
        """Tells how the run ended: "done", "failed" or "unfinished".

        It failed if it stopped before its end with numbers that were not finite.
        """
        last = self.lines[-1] if self.lines else {"update": 0}
        if self.planned is None or last["update"] >= self.planned:
            return "done"
        skipped = last.get("train/skipped_in_a_row") or 0
        # What is not finite stands as null in the file.
        null = [last.get(f"train/{name}", 0.0) is None for name in ("loss", "parameter_norm")]
        return "failed" if skipped >= MAX_SKIPPED_IN_A_ROW or any(null) else "unfinished"

    def curve(self, metric: str) -> dict[int, float]:
        """Returns steps -> value wherever the metric was measured and finite."""
        found = {line["steps"]: line.get(metric) for line in self.lines}
        return {steps: float(v) for steps, v in found.items() if v is not None and math.isfinite(v)}


def find_runs(arguments: Iterable[Path]) -> list[Path]:
    """Returns the runs' folders that the arguments mean, in order, each once.

    An argument is a run, a folder of runs (`runs/ant_run`, `runs`) or a pattern of these
    (`'runs/ant_run/a*'`). UserError if one means no run.
    """
    found: list[Path] = []
    for argument in arguments:
        places = sorted(map(Path, glob.glob(str(argument)))) or [argument]
        runs = [run for place in places for run in runs_in(place)]
        if not runs:
            kind = "holds no run" if argument.is_dir() else "is no run, folder of runs or pattern"
            raise UserError(f"{argument} {kind}: no config.json is there.")
        found += runs
    return list(dict.fromkeys(found))


def read(path: Path) -> RunRecord:
    """Reads one run's folder."""
    config = read_json(path / "config.json")
    try:
        settings = config["settings"]
        learning = {k: v for k, v in settings.items() if k not in NOT_LEARNING}
        return RunRecord(
            path=path,
            seed=settings["seed"],
            settings=_flatten({"experiment": config["experiment"]} | learning),
            manifest=read_json(path / "manifest.json"),
            source=(path / "experiment.py").read_bytes(),
            lines=read_metrics(path / "metrics.jsonl"),
            planned=_planned_updates(settings["ppo"]),
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path / 'config.json'} is not a run's: {one_line(error)}.") from error
    except OSError as error:
        raise UserError(f"{error.filename} cannot be read: {error.strerror}.") from error


def _flatten(value: Any, path: str = "") -> dict[str, Any]:
    """Returns nested settings as {"a.b": value}; lists stay whole."""
    if not isinstance(value, dict):
        return {path: value}
    inner = [_flatten(v, f"{path}.{k}" if path else k) for k, v in value.items()]
    return {k: v for part in inner for k, v in part.items()}


def _planned_updates(ppo: dict[str, Any]) -> int | None:
    try:
        return Config(**ppo).num_updates
    except (TypeError, ValueError):  # the settings of another version
        return None
