"""One page about runs, in one file: no network, no library, and nothing of the runs is executed.

What comes from files is text: `html_elements.py` escapes it, and the page's own policy lets a
browser execute `page.js` and nothing else.
"""

import base64
import hashlib
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from purerl.report import comparison, page_media, page_series, page_tables, run_reader
from purerl.report.html_elements import Html, element, join
from purerl.report.page_charts import SMALL, WIDE, chart, look, short
from purerl.report.seed_statistics import Group, make_groups

HERE = Path(__file__).parent
FOLDERS = re.compile(r"""(data:[^"]*)|(?<![\w./:<])/(?:[^/<>"\s]+/)+""")  # not in pictures


def make_page(runs: Sequence[run_reader.RunRecord], group_by: Sequence[str] = ()) -> str:
    """Returns the whole page as HTML; the same runs give the same page.

    Args:
      runs: what it is about; runs of one configuration and seed are drawn once.
      group_by: settings that make a group, as in `compare`.

    Raises:
      UserError: there is no such setting.
    """
    folders = [run.path for run in runs]
    runs = [run._replace(path=Path(*run.path.parts[-2:])) for run in runs]
    groups = make_groups(runs, group_by)
    result, _ = comparison.compare_records(runs, page_series.RETURN, group_by)
    sections = page_series.panels(groups)
    experiments = list(dict.fromkeys(run.settings["experiment"] for run in runs))
    title = f"{', '.join(experiments)}: {len(runs)} run{'s' * (len(runs) > 1)}"
    more = len(page_series.metric_names(runs)) - page_series.MOST_PANELS
    said = f"{more:,} more metrics have no chart: a page takes {page_series.MOST_PANELS}."
    body = [
        element("h1", title),
        *_section("Runs", page_tables.runs_table(runs)),
        *_section("Scores", *page_tables.scores(result)),
        _controls(groups),
        *_charts(sections, len(groups) > 1),
        *([element("p", said, class_="note")] if more > 0 else []),
        *_section("Last evaluation of each run", page_tables.evaluations(runs)),
        *_section("Settings", *page_tables.settings(runs, result)),
        *_section("Videos", *_media(folders)),
        element("div", id="tip", class_="off"),
    ]
    return _document(title, body, _data(sections, groups))


def _section(title: str, *inside: Html) -> list[Html]:
    return [element("h2", title), *inside] if any(inside) else []


def _document(title: str, body: Sequence[Html], data: Html) -> str:
    """Returns the page around its body."""
    style, script = (Html((HERE / f"page.{kind}").read_text()) for kind in ("css", "js"))
    policy = (
        f"default-src 'none'; style-src {_digest(style)}; script-src {_digest(script)}; "
        "img-src data:; media-src data:"
    )
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=policy),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("title", title),
        element("style", style),
    )
    # Without the folders of absolute paths, which are nobody else's business.
    sent = [Html(FOLDERS.sub(lambda found: found[1] or "", part)) for part in (*body, data)]
    inside = element("body", *sent, element("script", script))
    return f"<!DOCTYPE html>\n{element('html', head, inside, lang='en')}\n"


def _digest(content: str) -> str:
    """Returns how a policy names a style or script that stands in the page."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"


# --- curves ---


def _controls(groups: Sequence[Group]) -> Html:
    """Returns the legend, whose boxes show and hide lines, and the choice of scale."""
    several = len(groups) > 1
    parts = []
    for g, group in enumerate(groups):
        if len(group.runs) == 1:
            label = f"{group.label}: {group.runs[0].path.name}"
            parts.append(_box(f"g{g}", label, look(g, 0, several), key=f"{g}/0"))
            continue
        label = f"{group.label} (n = {len(group.runs)})"
        boxes = [_box(f"g{g}", label, look(g, None, several), key=f"{g}/mean")]
        for r, run in enumerate(group.runs):
            style = look(g, r, several)
            boxes.append(_box(f"g{g}r{r}", run.path.name, style, key=f"{g}/{r}", of=f"g{g}"))
        parts.append(element("div", *boxes, class_="group"))
    box = element("input", type="checkbox", id="log")
    log = element("label", box, "log scale", class_="choice")
    return element("div", *parts, log, class_="controls")


def _box(name: str, label: str, style: str, key: str, of: str | None = None) -> Html:
    box = element("input", type="checkbox", checked=True, id=name, data_key=key, data_of=of)
    return element("label", box, element("span", class_=f"swatch {style}"), label)


def _charts(sections: Sequence[tuple[str, list[page_series.Panel]]], several: bool) -> list[Html]:
    """Returns the charts under their headings; a metric that never changes is a line of text."""
    parts, number = [], 0
    for title, inside in sections:
        wide = title == page_series.SECTIONS[0][0]
        drawn, still = [], []
        for panel in inside:
            value = page_series.constant(panel)
            if value is None:
                drawn.append(chart(panel, number, WIDE if wide else SMALL, several))
            else:
                still.append(f"{panel.metric} = {short(value)}")
            number += 1
        parts.append(element("h2", title))
        if drawn:
            parts.append(element("div", *drawn, class_="charts wide" if wide else "charts"))
        if still:
            parts.append(element("p", f"The same at all times: {', '.join(still)}.", class_="note"))
        if wide:
            parts.append(element("p", BANDS, class_="note"))
    return parts


BANDS = (
    "Bands: around the evaluation of one run, one standard deviation over its episodes; around a "
    "heavy line (the interquartile mean of a group, below four seeds the mean), the 95% interval "
    "over five seeds or more; in training, the least and largest value where neighbouring points "
    "are drawn as one."
)


def _data(sections: Sequence[tuple[str, list[page_series.Panel]]], groups: Sequence[Group]) -> Html:
    """Returns what stands under the pointer, as JSON in which no element can end."""
    several = len(groups) > 1
    panels = [panel for _, inside in sections for panel in inside]
    found = [[_series_data(s, groups, several) for s in panel.series] for panel in panels]
    text = json.dumps(found, separators=(",", ":")).replace("<", "\\u003c")
    return element("script", Html(text), type="application/json", id="data")


def _series_data(
    series: page_series.Series, groups: Sequence[Group], several: bool
) -> dict[str, Any]:
    def rounded(values: list[float] | None) -> list[float] | None:
        return values and [float(f"{v:.6g}") for v in values]

    label = f"{groups[series.group].label}, {series.label}" if several else series.label
    return {
        "key": f"{series.group}/{'mean' if series.run is None else series.run}",
        "label": label,
        "look": look(series.group, series.run, several),
        "steps": series.steps,
        **{name: rounded(getattr(series, name)) for name in ("values", "low", "high")},
    }


# --- videos ---


def _media(folders: Sequence[Path]) -> list[Html]:
    room, parts = page_media.LARGEST_PAGE, list[Html]()
    for folder in folders:
        more, room = page_media.media_elements(folder, room)
        parts += more
    return [element("div", join(parts), class_="pictures")] if parts else []
