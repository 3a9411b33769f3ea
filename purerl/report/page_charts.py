"""Charts as inline SVG: each drawn twice, linear and logarithmic, and the page shows one."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from purerl.report.html_elements import Html, element
from purerl.report.page_series import Panel, Series

COLORS = 7  # in page.css; those after it come again, dashed
Place = Callable[[float], float]  # value -> pixels


class Frame(NamedTuple):
    """Where a chart stands in its picture [pixels]."""

    width: int
    height: int
    left: int = 56
    right: int = 12
    top: int = 8
    bottom: int = 24


WIDE, SMALL = Frame(600, 270), Frame(380, 170)


# --- numbers ---


def short(value: float) -> str:
    """Returns a number in few characters: 1.5k, 2M, 0.003.

    >>> [short(v) for v in (0, 1500, 2e6, 0.00300, -0.5, 1e12, 1e-7)]
    ['0', '1.5k', '2M', '0.003', '-0.5', '1e+12', '1e-07']
    """
    for unit, name in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if unit <= abs(value) < 1e12:
            return f"{value / unit:.4g}{name}"
    return f"{value:.4g}"


def ticks(low: float, high: float, most: int = 5) -> list[float]:
    """Returns round numbers from low to high, 1, 2 or 5 times a power of ten apart.

    >>> ticks(0.0, 10.0), ticks(0.2, 0.9)
    ([0.0, 2.0, 4.0, 6.0, 8.0, 10.0], [0.2, 0.4, 0.6, 0.8])
    """
    power = 10.0 ** math.floor(math.log10((high - low) / most))
    step = next(m * power for m in (1, 2, 5, 10) if (high - low) / (m * power) <= most)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [float(f"{i * step:.12g}") for i in range(first, last + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """Returns powers of ten from low to high, with what is between them if those are too few.

    >>> log_ticks(0.5, 2000.0), log_ticks(2.0, 60.0)
    ([1.0, 10.0, 100.0, 1000.0], [2.0, 5.0, 10.0, 20.0, 50.0])
    """
    exponents = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    every = max(1, len(exponents) // 6)
    for multiples in ((1,), (1, 2, 5)):
        found = [float(f"{m}e{e}") for e in exponents if e % every == 0 for m in multiples]
        found = [value for value in found if low <= value <= high]
        if len(found) > 2:
            return found
    return ticks(low, high)


def extent(values: Sequence[float]) -> tuple[float, float]:
    """Returns a range with some room around the values, from 0 where that is near."""
    low, high = min(values), max(values)
    if high - low <= 1e-9 * max(abs(low), abs(high)):
        room = abs(low) / 2 or 1.0
        return low - room, high + room
    room = 0.05 * (high - low)
    return 0.0 if 0 <= low < 0.4 * high else low - room, high + room


# --- pictures ---


def chart(panel: Panel, number: int, frame: Frame, several: bool) -> Html:
    """Returns one metric's chart.

    Args:
      panel: what it shows.
      number: of its data, for the page's script.
      frame: its size.
      several: there are several groups, which have a colour each; else each run has.
    """
    every = [v for s in panel.series for part in (s.values, s.low, s.high) if part for v in part]
    last = max(s.steps[-1] for s in panel.series) or 1
    across = _linear(0, last, frame.left, frame.width - frame.right)
    scales = [_scale(panel, frame, across, extent(every), "linear", several)]
    drawn = [v for s in panel.series for v in s.values]
    positive = min(drawn) > 0
    if positive:
        low, high = min(drawn), max(v for v in every if v > 0)
        scales.append(_scale(panel, frame, across, (low / 1.1, high * 1.1), "log", several))
    bottom = frame.height - frame.bottom
    labels = [
        element("text", short(x), x=f"{across(x):.1f}", y=bottom + 16, class_="tick below")
        for x in ticks(0, last, 4)
    ]
    cursor = element("line", x1=0, x2=0, y1=frame.top, y2=bottom, class_="cursor off")
    picture = element(
        "svg", *scales, *labels, cursor, viewBox=f"0 0 {frame.width} {frame.height}", role="img",
        aria_label=f"{panel.metric} over control steps", data_left=frame.left,
        data_right=frame.width - frame.right, data_last=last,
    )  # fmt: skip
    note = element("small", " linear: not all values are above 0", class_="only-linear")
    caption = element("figcaption", panel.metric, note if not positive else "")
    kind = "chart both" if positive else "chart"
    return element("figure", caption, picture, class_=kind, data_panel=number)


def _linear(low: float, high: float, start: float, end: float) -> Place:
    """Returns the map of [low, high] to [start, end]."""
    return lambda v: start + (end - start) * ((v - low) / (high - low))


def _logarithmic(low: float, high: float, start: float, end: float) -> Place:
    """Returns the logarithmic map of [low, high] to [start, end]; what is below stays at start."""
    place = _linear(math.log10(low), math.log10(high), start, end)
    return lambda v: place(math.log10(max(v, low)))


def _scale(
    panel: Panel, frame: Frame, across: Place, around: tuple[float, float], kind: str, several: bool
) -> Html:
    """Returns grid and lines of one scale."""
    low, high = around
    bottom = frame.height - frame.bottom
    between, marks = (_logarithmic, log_ticks) if kind == "log" else (_linear, ticks)
    up = between(low, high, bottom, frame.top)
    right, grid = frame.width - frame.right, []
    for y in marks(low, high):
        at, below = f"{up(y):.1f}", f"{up(y) + 4:.1f}"
        grid.append(element("line", x1=frame.left, x2=right, y1=at, y2=at, class_="grid"))
        grid.append(element("text", short(y), x=frame.left - 6, y=below, class_="tick beside"))
    # Means last, over the runs.
    series = sorted(panel.series, key=lambda s: s.run is None)
    # Where groups have means, their runs step back.
    means = {s.group for s in series if s.run is None} if several else set()
    drawn = [part for s in series for part in _draw(s, across, up, several, s.group in means)]
    return element("g", *grid, *drawn, class_=f"scale {kind}")


def look(group: int, run: int | None, several: bool) -> str:
    """Returns the classes that give a line its colour and dashes."""
    number = group if several else run
    if number is None:  # the mean of the only group
        return "ink"
    return f"c{number % COLORS} d{min(number // COLORS, 2)}"


def _draw(series: Series, across: Place, up: Place, several: bool, faint: bool) -> list[Html]:
    xs = [across(s) for s in series.steps]
    about = {"data_group": series.group, "data_run": "mean" if series.run is None else series.run}
    style = look(series.group, series.run, several)
    parts = []
    if series.low and series.high:
        edge = list(zip(xs, map(up, series.high), strict=True))
        edge += reversed(list(zip(xs, map(up, series.low), strict=True)))
        parts.append(element("path", d=_path(edge) + "Z", class_=f"band {style}", **about))
    points = list(zip(xs, map(up, series.values), strict=True))
    if len(points) == 1:  # a path of one point shows nothing
        points.append((points[0][0] + 2, points[0][1]))
    kind = "mean" if series.run is None else "line faint" if faint else "line"
    return [*parts, element("path", d=_path(points), class_=f"{kind} {style}", **about)]


def _path(points: Sequence[tuple[float, float]]) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points)
