"""What a swept setting may be: values to choose from, or a range to draw from.

1e-4,3e-4       values, of which a grid takes each
1..8            every whole number of a range; of a setting that is no whole number, any number;
                without a number beside the dots, as in ../body.xml, they are part of a value
log:1e-5:1e-2   the same, the logarithm drawn evenly
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from purerl.core.errors import UserError

MOST_POINTS = 10_000
MOST_TRIES = 1000  # draws in a row that bring no new point
Values = dict[str, str]  # setting -> its value, as on a command line


class Space(NamedTuple):
    """What one setting may be."""

    setting: str  # "ppo.learning-rate"
    choices: tuple[str, ...]  # empty: a range
    low: float = 0.0
    high: float = 0.0
    whole: bool = False  # whole numbers alone
    log: bool = False

    @property
    def ends(self) -> tuple[str, ...]:
        """The values to check: all choices, or both ends of the range."""
        return self.choices or (self.text(self.low), self.text(self.high))

    def text(self, value: float) -> str:
        """Returns a number of the range as on a command line."""
        return str(round(value)) if self.whole else f"{value:.6g}"


def parse_space(setting: str, text: str, whole: bool) -> Space:
    """Reads what stands behind `SETTING=`.

    Args:
      setting: the setting's name.
      text: its values or its range.
      whole: whether the setting is a whole number.

    Raises:
      UserError: it is neither, or a range is empty.
    """
    log = text.startswith("log:")
    first, separator, last = text.removeprefix("log:").partition(":" if log else "..")
    low, high = _number(first), _number(last)
    if not log and (not separator or (math.isnan(low) and math.isnan(high))):
        choices = tuple(" ".join(part.split()) for part in text.split(",") if part.strip())
        if not choices:
            raise UserError(f"{setting} has no value; give it as {setting}=1,2,3.")
        return Space(setting, choices)
    if not (math.isfinite(low) and math.isfinite(high)):
        raise UserError(
            f"{setting} is {text}; a range is two numbers, as {setting}=1..8 or {setting}=log:1:8."
        )
    if whole and not (low.is_integer() and high.is_integer()):
        raise UserError(f"{setting} is {text}; it is a whole number, and so must both ends be.")
    if low >= high or (log and low <= 0):
        rule = "the lower end must come first" + " and be above 0" * log
        raise UserError(f"{setting} is {text}; {rule}.")
    return Space(setting, (), low, high, whole, log)


def _number(text: str) -> float:
    """Returns what a text says, NaN where it is no number."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def grid(spaces: Sequence[Space]) -> list[Values]:
    """Returns every combination of values, the last setting changing fastest.

    Raises:
      UserError: a range has no end of values, or there are more than `MOST_POINTS` points.
    """
    for space in spaces:
        if not space.choices and (space.log or not space.whole):
            raise UserError(
                f"{space.setting} is a range, of which a grid would take no end of values; list "
                "some, or draw them: --random 20 --over " + _shown(space)
            )
    sizes = (len(space.choices) or round(space.high - space.low) + 1 for space in spaces)
    if (number := math.prod(sizes)) > MOST_POINTS:
        raise UserError(  # before any list is made
            f"The grid has {number:,} points, of at most {MOST_POINTS:,}; leave values out, or "
            "draw some of them with --random and --over."
        )
    every = [x.choices or map(str, range(round(x.low), round(x.high) + 1)) for x in spaces]
    names = [space.setting for space in spaces]
    return [dict(zip(names, values, strict=True)) for values in itertools.product(*every)]


def _shown(space: Space) -> str:
    low, high = space.ends
    return f"{space.setting}=" + (f"log:{low}:{high}" if space.log else f"{low}..{high}")


def draw(spaces: Sequence[Space], number: int) -> list[Values]:
    """Draws different points; the first ones are the same, however many are drawn.

    Raises:
      UserError: there are not so many different points, or more than `MOST_POINTS`.
    """
    check_number("random", number)
    generator, found, tries = np.random.default_rng(0), dict[tuple[str, ...], Values](), 0
    while len(found) < number:
        if tries > MOST_TRIES:
            raise UserError(
                f"Only {len(found)} different points can be drawn; lower --random, or take them "
                "all with --grid."
            )
        point = {space.setting: _draw_one(space, generator) for space in spaces}
        tries = tries + 1 if tuple(point.values()) in found else 0
        found[tuple(point.values())] = point
    return list(found.values())


def check_number(option: str, number: int) -> None:
    """Raises UserError unless a number of points can be carried out."""
    if not 1 <= number <= MOST_POINTS:
        raise UserError(f"{option} is {number:,}; it must be from 1 to {MOST_POINTS:,} points.")


def _draw_one(space: Space, generator: np.random.Generator) -> str:
    if space.choices:
        return space.choices[generator.integers(len(space.choices))]
    # Each whole number has the same share of the range.
    low, high = (space.low - 0.5, space.high + 0.5) if space.whole else (space.low, space.high)
    if space.log:
        value = math.exp(generator.uniform(math.log(low), math.log(high)))
    else:
        value = generator.uniform(low, high)
    return space.text(min(max(value, space.low), space.high))
