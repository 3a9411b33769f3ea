"""Reads runs back from their folders: settings, metrics, and how far each run came."""

import glob
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from purerl.core.errors import UserError, one_line, unknown_name
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
    planned: int | None  # updates; None where the settings do not say

    @property
    def update(self) -> int:
        """The last update in metrics.jsonl; 0 without any."""
        return self.lines[-1]["update"] if self.lines else 0

    @property
    def status(self) -> str:
        """Tells how the run ended: "done", "failed" or "unfinished".

        It failed if it stopped before its end with numbers that were not finite.
        """
        if self.planned is None or self.update >= self.planned:
            return "done"
        last = self.lines[-1] if self.lines else {}
        skipped = last.get("train/skipped_in_a_row") or 0
        # What is not finite stands as null in the file.
        null = [last.get(f"train/{name}", 0.0) is None for name in ("loss", "parameter_norm")]
        lost = skipped >= MAX_SKIPPED_IN_A_ROW or any(null)
        return "failed" if lost else "unfinished"

    def curve(self, metric: str) -> dict[int, float]:
        """Returns steps -> value wherever the metric was measured and finite."""
        found = {line["steps"]: line.get(metric) for line in self.lines}
        return {steps: float(v) for steps, v in found.items() if v is not None and math.isfinite(v)}

    def digests(self) -> dict[int, str]:
        """Returns update -> digest, of every planned checkpoint."""
        return {line["update"]: line["digest"] for line in self.lines if "digest" in line}


def find_runs(arguments: Iterable[Path]) -> list[Path]:
    """Returns the runs' folders that the arguments mean, in order, each once.

    Args:
      arguments: runs, folders of runs (`runs/ant_run`, `runs`), or patterns (`'runs/ant_run/a*'`).

    Raises:
      UserError: one of them means no run.
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
            settings=flatten({"experiment": config["experiment"]} | learning),
            manifest=read_json(path / "manifest.json"),
            source=(path / "experiment.py").read_bytes(),
            lines=read_metrics(path / "metrics.jsonl"),
            planned=planned_updates(settings["ppo"]),
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path / 'config.json'} is not a run's: {one_line(error)}.") from error
    except OSError as error:
        raise UserError(f"{error.filename} cannot be read: {error.strerror}.") from error


def flatten(value: Any, path: str = "") -> dict[str, Any]:
    """Returns nested settings as {"a.b": value}; lists stay whole."""
    if not isinstance(value, dict):
        return {path: value}
    inner = [flatten(v, f"{path}.{k}" if path else k) for k, v in value.items()]
    return {k: v for part in inner for k, v in part.items()}


def planned_updates(ppo: dict[str, Any]) -> int | None:
    """Returns how many updates a run's settings ask for; None if this version cannot read them."""
    try:
        return Config(**ppo).num_updates
    except (TypeError, ValueError):
        return None


def check_metric(runs: Sequence[RunRecord], metric: str) -> None:
    """Raises UserError unless some run has the metric."""
    names = {name for run in runs for line in run.lines for name in line}
    names -= {"update", "steps", "wall_s", "digest"}
    if metric not in names:
        raise UserError(unknown_name("metric", metric, sorted(names), " in these runs"))


def _read_lines(path: Path) -> list[dict[str, Any]]:
    """Reads whole lines; a run that is being written may end in half a line."""
    if not path.exists():
        return []
    texts = path.read_text().split("\n")[:-1]
    try:
        return [json.loads(text) for text in texts]
    except ValueError as error:
        raise UserError(f"{path} has a line that is no JSON: {one_line(error)}") from error
