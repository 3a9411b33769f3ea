"""The files of runs: JSON, written whole or not at all, and which folders are runs. No JAX."""

import json
from pathlib import Path
from typing import Any

from purerl.core.errors import UserError, one_line


def read_json(path: Path) -> dict[str, Any]:
    """Reads a JSON file; UserError if it is missing or broken."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read: {one_line(error)}") from error


def write_json(path: Path, value: dict[str, Any]) -> None:
    """Writes a JSON file whole or not at all; UserError if the disk refuses."""
    try:
        draft_of(path).write_text(json.dumps(value, indent=2) + "\n")
        draft_of(path).replace(path)
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror}.") from error


def draft_of(path: Path) -> Path:
    """Returns the file that holds what `path` will hold once it is whole."""
    return path.with_name(f".{path.name}.draft")


def runs_in(place: Path) -> list[Path]:
    """Returns the run that a folder is, or the runs one or two levels below it; [] for none."""
    for pattern in ("config.json", "*/config.json", "*/*/config.json"):
        runs = sorted(file.parent for file in place.glob(pattern))
        if runs:
            return runs
    return []
