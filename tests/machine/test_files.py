"""Files: where they are written, whatever stands there and whatever their folder is called."""

import csv
import io
import os

import numpy as np
import pytest

from purerl import UserError
from purerl.machine import array_files, files
from purerl.machine.lock import LOCK, FolderLock


@pytest.mark.parametrize("name", ["lr[1]", "a\\b", "gs:", "a*?{x}%03d#'é"])
def test_arrays_are_kept_in_a_folder_of_any_name(tmp_path, name):
    folder, arrays = tmp_path / name, {"a/b": np.arange(5.0), "c[1]\\*": np.ones((2, 3), np.int8)}
    folder.mkdir()
    array_files.write(folder / "state", arrays)
    found = array_files.read(folder / "state", arrays)
    assert all(np.array_equal(found[key], arrays[key]) for key in arrays)
    assert os.listdir(tmp_path) == [name] and os.listdir(folder) == ["state"]


def test_nothing_is_written_through_a_link(tmp_path):
    target, folder = tmp_path / "target", tmp_path / "folder"
    target.write_text("mine")
    folder.mkdir()
    file = folder / "sweep.csv"
    for path in (files.draft_of(file), file, folder / LOCK, folder / "a.log"):
        path.symlink_to(target)
    files.write_file(file, b"new")
    assert file.read_text() == "new" and not file.is_symlink()
    with pytest.raises(OSError, match="symbolic links"):
        files.open_log(folder / "a.log")
    with pytest.raises(OSError, match="symbolic links"):
        FolderLock(folder, patience=0.0)
    os.mkfifo(folder / "pipe")
    with pytest.raises(OSError, match="No such device"):  # no reader: it would wait for ever
        files.open_log(folder / "pipe")
    assert target.read_text() == "mine" and not files.draft_of(file).exists()


def test_a_cell_of_a_table_is_no_formula_and_commands_no_terminal():
    rows = [
        {"a": "=1+1", "b": "-2+3+cmd|' /C calc'!A0", "=c": "@x"},
        {"a": "\x1b[2J\t\r\ud800", "b": -0.5, "=c": None, "left out": 1},
        {"a": "-1e-05", "b": "+0.5", "=c": "a=b, c"},
    ]
    head, *found = csv.reader(io.StringIO(files.as_csv(["a", "b", "=c"], rows).decode()))
    assert head == ["a", "b", "'=c"]
    assert found == [
        ["'=1+1", "'-2+3+cmd|' /C calc'!A0", "'@x"],
        ["\\x1b[2J\\t\\r\\ud800", "-0.5", ""],
        ["-1e-05", "+0.5", "a=b, c"],
    ]


def test_a_draft_that_cannot_be_removed_is_told_in_one_line(tmp_path):
    files.draft_of(tmp_path / "a").mkdir()
    with pytest.raises(UserError, match="a cannot be written: Is a directory"):
        files.write_file(tmp_path / "a", b"")
