"""Writes a project of a person's own: an environment, its body, an experiment and a test."""

import keyword
import os
import tempfile
from pathlib import Path

from purerl.core.errors import UserError

TEMPLATES = Path(__file__).parent / "templates"
ADDED = ".txt"  # Python files there are no source of this package: no hash of a run counts them


def write_project(folder: Path) -> list[Path]:
    """Writes the files of a new project, all or none; returns them.

    Args:
      folder: where; its last part is the project's name.

    Raises:
      UserError: the name is no Python identifier, there is such a file or folder, or it cannot be
        written there.
    """
    name = folder.name
    _check_name(name)
    if os.path.lexists(folder):
        raise UserError(f"{folder} exists: choose another name, or remove it.")
    if not folder.absolute().parent.is_dir():
        raise UserError(f"{folder} cannot be written: there is no folder {folder.parent}.")
    try:
        _write_whole(folder, {file: text.replace("NAME", name) for file, text in _files().items()})
    except OSError as error:
        raise UserError(f"{folder} cannot be written: {error.strerror}.") from error
    return [folder / file for file in _files()]


def _check_name(name: str) -> None:
    if not (name.isascii() and name.isidentifier()) or keyword.iskeyword(name):
        raise UserError(
            f"The project's name is {name!r}; it must be a Python name, such as my_robot: letters, "
            "digits and _, no digit first, and no word of the language."
        )


def _files() -> dict[str, str]:
    """Returns file name -> text of the template."""
    found = {path.name: path.read_text() for path in sorted(TEMPLATES.iterdir())}
    return {name.removesuffix(ADDED): text for name, text in found.items()}


def _write_whole(folder: Path, files: dict[str, str]) -> None:
    """Writes into a folder beside it first, so that nothing half made stands under its name."""
    with tempfile.TemporaryDirectory(prefix=".", dir=folder.absolute().parent) as place:
        draft = Path(place, folder.name)
        draft.mkdir()
        for name, text in files.items():
            (draft / name).write_text(text)
        draft.rename(folder.absolute())
