"""The table and the picture of a sweep: what stands where."""

from pathlib import Path

import pytest

from purerl.experiment.loading import find_source
from purerl.experiment.options import RunOptions
from purerl.tune.sweep import table
from purerl.tune.sweep.points import Base, Point
from purerl.tune.sweep.spaces import parse_space
from purerl.tune.sweep.table import Row, by_value
from tests.training.test_run import TOY


def row(number: int, score, status: str = "done", **values) -> Row:
    texts = {name: str(value) for name, value in values.items()}
    runs = {} if score is None else {"seed1": score}
    summary = {
        "score": score,
        "iqm": None,
        "n": len(runs),
        "runs": runs,
        "interval": None,
        "mean": score,
    }
    summary |= {"worst": score, "done": len(runs), "failed": 0, "unfinished": 0}
    return Row(Point(number, texts), values, status, "", summary)


def test_numbers_stand_in_the_order_of_numbers():
    values = ["b", 100, 20, 3.5, (64, 8), (8, 64), True, "a"]
    assert sorted(values, key=by_value) == [3.5, 20, 100, (8, 64), (64, 8), True, "a", "b"]


def test_the_best_whole_point_is_first_and_what_has_no_score_last():
    rows = [
        row(0, None, "waiting", x=1), row(1, 5.0, x=100), row(2, 9.0, "failed", x=1),
        row(3, 5.0, x=20), row(4, 7.0, x=3), row(5, None, "failed", x=0),
        row(6, 8.0, "stopped", x=1),
    ]  # fmt: skip
    assert [one.point.number for one in sorted(rows, key=table._rank)] == [4, 3, 1, 6, 2, 5, 0]


def test_axes_are_logarithmic_where_values_are():
    ranges = {"log:1e-5:1e-2": True, "0.1..100": False}
    for text, is_log in ranges.items():
        assert table.has_log_axis(parse_space("x", text, False), [1.0]) is is_log
    listed = parse_space("x", "1,2", False)
    assert table.has_log_axis(listed, [1e-4, 1e-3])
    for values in ([1, 2, 3], [0, 1, 100], ["a", "b"], [(8,), (800,)]):
        assert not table.has_log_axis(listed, values)


@pytest.mark.slow
def test_any_kind_of_value_is_drawn(tmp_path):
    spaces = [parse_space(name, "1,2", False) for name in ("rate", "widths", "kind", "one")]
    rows = [
        row(0, 2.0, rate=1e-3, widths=(8, 8), kind="$a", one=1),
        row(1, 1.0, rate=1e-4, widths=(16,), kind="b", one=1),
        row(2, None, "failed", rate=1e-2, widths=(), kind="c", one=1),
    ]
    assert table.draw(tmp_path / "a.png", rows, spaces, "eval/x")
    assert (tmp_path / "a.png").stat().st_size > 5000
    assert not table.draw(tmp_path / "b.png", rows[2:], spaces, "eval/x")


def test_digits_are_few_and_what_has_no_run_brings_no_note():
    rows = [row(0, 1.0, x=0.000123456789), row(1, None, "failed", x=3)]
    rows[0].summary.update(n=5, done=5, interval={"low": 0.5, "high": 1.5})
    lines = table.describe(rows, [parse_space("x", "1", False)], "eval/x")
    assert "0.0001235" in lines[2] and "[0.5, 1.5]" in lines[2]
    assert lines[4:] == ["p0001 failed: "]


def test_a_point_that_has_not_begun_waits(tmp_path):
    source = find_source(str(TOY))
    base = Base(str(TOY), source, source.experiment, (), 2, Path(tmp_path), RunOptions())
    (found,) = table.make_rows(base, [Point(0, {"ppo.gamma": "0.9"})], "eval/episode_return")
    assert (found.status, found.typed) == ("waiting", {"ppo.gamma": 0.9})
    said = table.describe([found], [parse_space("ppo.gamma", "0.9", False)], "eval/x")
    assert said[0] == "1 point (1 waiting), eval/x at the end"
