"""The tables of a page: how far the runs came, what they scored, how they were set."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from purerl.report.comparison import GROUPS, VERSUS, cell, notes
from purerl.report.html_elements import Html, element, join, table
from purerl.report.page_series import RETURN, SPREAD
from purerl.report.run_reader import RunRecord, flatten

FIRST = [RETURN, SPREAD, f"{RETURN}_min", f"{RETURN}_max", "eval/episode_length", "eval/lost"]
MANY = 200  # characters of a value, after which it is cut


def runs_table(runs: Sequence[RunRecord]) -> Html:
    """Returns a line about each run: how far it came, and whether it can be had again."""
    head = ["run", "seed", "state", "updates", "steps", "time", "bit-exact", "engine", "digest"]
    return table(head, [_run_row(run) for run in runs], "runs")


def _run_row(run: RunRecord) -> list[Any]:
    last = run.lines[-1] if run.lines else {"update": 0, "steps": 0}
    of = "" if run.planned is None else f" of {run.planned:,}"
    kind = {"done": "good", "failed": "bad"}.get(run.status)
    device = run.manifest.get("device")
    place = device.get("kind", "") if isinstance(device, dict) else ""
    return [
        run.path.name,
        run.seed,
        element("span", run.status, class_=kind),
        f"{last['update']:,}{of}",
        f"{last['steps']:,}",
        _duration(last.get("wall_s")),
        _exactness(run.manifest),
        _cut(f"{run.manifest.get('engine', '')}, {place}".strip(", ")),
        element("code", _digest(run)),
    ]


def _duration(seconds: float | None) -> str:
    """Returns seconds as h:mm:ss.

    >>> _duration(3671.4), _duration(None)
    ('1:01:11', '-')
    """
    if seconds is None or not 0 <= seconds < 1e12:
        return "-"
    minutes, seconds = divmod(int(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{seconds:02}"


def _exactness(manifest: dict[str, Any]) -> Html:
    """Returns whether the run's bits can be had again, as its manifest says, and why not."""
    said = manifest.get("bit_exact")
    if said is True:
        return element("span", "yes", class_="good")
    why = manifest.get("inexact_because")
    reasons = "; ".join(map(str, why)) if isinstance(why, list) else ""
    word = element("span", "no" if said is False else "not said", class_="bad")
    return join([word, _cut(f": {reasons}") if reasons else ""])


def _digest(run: RunRecord) -> str:
    found = [line for line in run.lines if "digest" in line]
    return f"{found[-1]['digest'][:64]} (update {found[-1]['update']:,})" if found else "-"


def scores(result: dict[str, Any]) -> list[Html]:
    """Returns what `compare` finds of these runs: bits, groups, and differences between them."""
    parts = [
        element("p", f"{pair['first']} and {pair['second']}, of one configuration and seed: {line}")
        for pair in result["pairs"]
        for line in pair["lines"]
    ]
    if result["unscored"]:
        return [*parts, element("p", result["unscored"], class_="note")]
    parts.append(element("p", f"{result['metric']} at the end of the runs.", class_="note"))
    short_named = [g | {"worst_run": Path(g["worst_run"]).name} for g in result["groups"]]
    parts.append(_records(GROUPS, short_named))
    if result["versus_first"]:
        baseline = result["versus_first"][0]["baseline"]
        parts += [element("p", f"Against {baseline}:"), _records(VERSUS, result["versus_first"])]
    return parts + [element("p", note, class_="note") for note in notes(result["groups"])]


def _records(columns: Sequence[tuple[str, str]], records: Sequence[dict[str, Any]]) -> Html:
    rows = [[cell(record[key]) for _, key in columns] for record in records]
    return table([head for head, _ in columns], rows, "numbers")


def evaluations(runs: Sequence[RunRecord]) -> Html:
    """Returns every metric of each run's last evaluation; empty if there was none."""
    last = [next((x for x in reversed(run.lines) if RETURN in x), None) for run in runs]
    names = dict.fromkeys(name for line in last if line for name in line if name[:5] == "eval/")
    every = [n for n in FIRST if n in names] + sorted(names.keys() - FIRST)
    if not every:
        return Html("")
    rows = [
        [run.path.name, f"{line['steps']:,}", *(_cut(cell(line.get(name))) for name in every)]
        for run, line in zip(runs, last, strict=True)
        if line
    ]
    return table(["run", "steps", *(name[5:] for name in every)], rows, "numbers")


def settings(runs: Sequence[RunRecord], result: dict[str, Any]) -> list[Html]:
    """Returns what differs between the runs, then all settings and conditions of the first."""
    differ = list(result["settings_that_differ"])
    parts = []
    if differ:
        rows = [[run.path.name, *(_cut(run.settings.get(n)) for n in differ)] for run in runs]
        parts.append(table(["what differs", *differ], rows))
    elif len(runs) > 1:
        parts.append(element("p", "The runs differ in no setting but the seed.", class_="note"))
    for line in result["conditions_that_differ"]:
        parts.append(element("p", f"Other conditions: {_cut(line)}", class_="note"))
    hidden = ("source", "experiment_file")
    conditions = flatten({k: v for k, v in runs[0].manifest.items() if k not in hidden})
    return [
        *parts,
        _details(f"All settings of {runs[0].path.name}", runs[0].settings),
        _details(f"Conditions of {runs[0].path.name}: versions, device, flags", conditions),
    ]


def _details(title: str, values: dict[str, Any]) -> Html:
    rows = [[name, _cut(value)] for name, value in values.items()]
    return element("details", element("summary", title), table(["name", "value"], rows))


def _cut(value: Any) -> str:
    said = str(value)
    return said if len(said) <= MANY else f"{said[:MANY]}..."
