"""The points of a sweep: values, ranges, draws; and what is wrong with them, in one line."""

import math

import pytest

from purerl.core.errors import UserError
from purerl.tune.sweep import spaces
from purerl.tune.sweep.spaces import parse_space


def test_a_grid_takes_every_combination_in_order():
    found = spaces.grid(
        [parse_space("a", "1e-4, 3e-4", False), parse_space("b", "8 8,16", False),
         parse_space("c", "1..2", True)]
    )  # fmt: skip
    assert len(found) == 8
    assert found[0] == {"a": "1e-4", "b": "8 8", "c": "1"}
    assert found[1] == {"a": "1e-4", "b": "8 8", "c": "2"}
    assert found[-1] == {"a": "3e-4", "b": "16", "c": "2"}


def test_dots_without_a_number_beside_them_are_part_of_a_value():
    for text in ("../a.xml,../b.xml", "../a.xml", "a..b,1"):
        assert parse_space("x", text, False).choices == tuple(text.split(","))


@pytest.mark.parametrize(
    ("text", "whole", "said"),
    [
        ("", False, "x has no value"),
        (" , ", False, "x has no value"),
        ("8..1", True, "the lower end must come first"),
        ("log:0:1", False, "above 0"),
        ("log:1", False, "a range is two numbers"),
        ("log:1:nan", False, "a range is two numbers"),
        ("1..many", False, "a range is two numbers"),
        ("few..8", False, "a range is two numbers"),
        ("1..2.5", True, "a whole number, and so must both ends be"),
    ],
)
def test_what_is_no_space(text, whole, said):
    with pytest.raises(UserError, match=said):
        parse_space("x", text, whole)


def test_a_grid_has_an_end():
    many = parse_space("x", "1..101", True)
    with pytest.raises(UserError, match="10,201 points, of at most 10,000"):
        spaces.grid([many, many._replace(setting="y")])
    with pytest.raises(UserError, match="1,000,000,000 points"):  # before any list is made
        spaces.grid([parse_space("x", "1..1000000000", True)])
    with pytest.raises(UserError, match=r"--random 20 --over x=log:1:8$"):
        spaces.grid([parse_space("x", "log:1:8", False)])


def test_draws_cover_their_ranges_and_the_first_ones_stay():
    ranges = [
        parse_space("rate", "log:1e-5:1e-1", False), parse_space("epochs", "1..4", True),
        parse_space("width", "8,16,32", True), parse_space("gamma", "0.9..1", False),
    ]  # fmt: skip
    found = spaces.draw(ranges, 400)
    assert found[:7] == spaces.draw(ranges, 7)
    logs = sorted(math.log10(float(point["rate"])) for point in found)
    assert -5 <= logs[0] < -4.9 and -3.3 < logs[200] < -2.7 and -1.1 < logs[-1] <= -1
    counts = [sum(point["epochs"] == str(n) for point in found) for n in range(1, 5)]
    assert sum(counts) == 400 and min(counts) > 70  # the ends as often as the rest
    assert {point["width"] for point in found} == {"8", "16", "32"}
    gammas = [float(point["gamma"]) for point in found]
    assert 0.9 <= min(gammas) < 0.905 < 0.995 < max(gammas) <= 1


def test_draws_are_different_points():
    few = [parse_space("a", "1,2", True), parse_space("b", "1..3", True)]
    found = spaces.draw(few, 6)
    assert len({tuple(point.values()) for point in found}) == 6
    with pytest.raises(UserError, match="Only 6 different points"):
        spaces.draw(few, 7)
    with pytest.raises(UserError, match="random is 10,001"):
        spaces.draw(few, 10_001)
