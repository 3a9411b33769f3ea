"""`python -m purerl.plot RUN ...`: curves in a terminal and as a picture."""

import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from purerl import plot
from purerl.core.errors import USAGE
from tests.report.test_compare import ROOT, make_run, make_seeds, only_line


@pytest.fixture
def terminal(monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setenv("LINES", "20")


def test_a_straight_line_is_straight_and_as_wide_as_the_terminal(tmp_path, terminal, capsys):
    make_run(tmp_path / "a", 1, [100.0, 200.0, 300.0, 400.0])
    assert plot.main([str(tmp_path / "a")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "eval/episode_return" and max(map(len, lines)) <= 60
    field = [line.partition("|")[2] for line in lines[1:15]]
    marks = sorted((x, -y) for y, row in enumerate(field) for x, c in enumerate(row) if c == "*")
    assert marks[-1][0] == 48 and marks[0][0] == 12  # steps 100 of 400
    assert [x for x, _ in marks] == list(range(12, 49))
    heights = np.array(marks, float)
    slope, start = np.polyfit(heights[:, 0], heights[:, 1], 1)
    assert slope > 0 and np.abs(heights[:, 1] - slope * heights[:, 0] - start).max() < 0.8
    assert lines[15].endswith("-" * 49) and lines[16].endswith("400 steps")
    assert lines[17] == "  *  walk (n = 1)"
    assert "".join(lines).isascii()


def test_groups_have_marks_and_unfinished_runs_are_drawn(tmp_path, terminal, capsys):
    make_seeds(tmp_path / "runs", "a", [1.0, 2.0])
    make_run(tmp_path / "runs" / "b", 1, [5.0, 6.0], rate=1.0)
    assert plot.main([str(tmp_path / "runs"), "--out", str(tmp_path / "f.png")]) == 0
    said = capsys.readouterr().out
    assert "*  ppo.learning_rate=0.001 (n = 2)" in said
    assert "o  ppo.learning_rate=1.0 (n = 1)" in said and said.count("o") > 20
    for kind, begins in ((".pdf", b"%PDF"), (".svg", b"<?xml")):
        assert plot.main([str(tmp_path / "runs"), "--out", str(tmp_path / f"f{kind}")]) == 0
        assert (tmp_path / f"f{kind}").read_bytes().startswith(begins)
    assert b"/Type3" not in (tmp_path / "f.pdf").read_bytes()  # text stays text
    with Image.open(tmp_path / "f.png") as picture:
        colors = {tuple(c) for c in np.asarray(picture.convert("RGB")).reshape(-1, 3)}
    assert len(colors) > 20
    assert any(r > 220 and 100 < g < 220 and b < 160 for r, g, b in colors)  # the unfinished one


def test_other_metrics_and_odd_numbers(tmp_path, terminal, capsys):
    for i, values in enumerate([[1e308, -1e308, 1.0], [5e-324], [1.0, 1.0]]):
        make_run(tmp_path / str(i), 1, values)
        assert plot.main([str(tmp_path / str(i))]) == 0
    assert plot.main([str(tmp_path / "2"), "--metric", "train/loss"]) == 0
    assert "0.5" in capsys.readouterr().out


def test_a_narrow_terminal_is_no_fault(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "1")
    monkeypatch.setenv("LINES", "1")
    assert plot.main([str(make_run(tmp_path / "a", 1, [1.0, 2.0]))]) == 0
    assert "*" in capsys.readouterr().out.partition("(n = 1)")[0]


def test_a_mistake_is_one_line(tmp_path, capsys):
    run = str(make_run(tmp_path / "a", 1, [1.0] * 4, more={"train/kl": None}))
    for words, part in [
        ([], "Give the runs"),
        ([str(tmp_path / "nowhere")], "no run"),
        ([run, "--metric", "eval/episode_retrun"], "Did you mean 'eval/episode_return'?"),
        ([run, "--metric", "train/kl"], "no finite value"),
        ([run, "--out", str(tmp_path / "f.bmp")], "end in .png, .pdf or .svg"),
        ([run, "--out", str(tmp_path / "no" / "f.png")], "cannot be written"),
    ]:
        assert plot.main(words) == USAGE, words
        assert part in only_line(capsys)


def test_a_curve_is_drawn_without_jax(tmp_path):
    make_run(tmp_path / "a", 1, [1.0] * 4)
    code = "import sys; from purerl import plot; code = plot.main(sys.argv[1:]); "
    code += "assert not {'jax', 'mujoco', 'matplotlib'} & set(sys.modules); sys.exit(code)"
    words = [sys.executable, "-c", code, str(tmp_path / "a")]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
