"""`python -m purerl.report RUN ...`: one HTML page, which executes nothing of a run's."""

import html.parser
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from purerl.core.errors import USAGE
from purerl.report import (
    __main__ as report,
    html_elements,
    page_charts,
    page_media,
    page_series,
    run_reader,
)
from purerl.report.page import make_page
from tests.report import chromium
from tests.report.test_compare import ROOT, make_run, make_seeds, only_line

EVIL = "<script>alert(1)</script>"
QUOTED = "\"'><img src=x onerror=alert(1)>"
PNG, MP4 = b"\x89PNG\r\n\x1a\n" + b"sheet", b"\0\0\0\x20ftypisom" + b"video"


class Reader(html.parser.HTMLParser):
    """A page's elements, as a browser would find them: (name, attributes, text)."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements, self.open = [], []
        self.feed(text)
        assert not self.open, f"not closed: {self.open}"

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs), []))
        if tag not in html_elements.VOID:
            self.open.append((tag, self.elements[-1]))

    def handle_endtag(self, tag):
        assert self.open.pop()[0] == tag

    def handle_data(self, data):
        for _, element in self.open:
            element[2].append(data)

    def find(self, tag, **attributes):
        return [
            (about, "".join(inside))
            for name, about, inside in self.elements
            if name == tag and attributes.items() <= about.items()
        ]

    def texts(self, tag, **attributes):
        return [text for _, text in self.find(tag, **attributes)]


def read(tmp_path: Path, *words) -> Reader:
    out = tmp_path / "report.html"
    assert report.main([*map(str, words), "--out", str(out)]) == 0
    return Reader(out.read_text())


def data(page: Reader):
    return json.loads(page.texts("script", id="data")[0])


def paths(page: Reader, metric: str) -> list[dict]:
    """The lines that the linear scale of a metric's chart has."""
    (svg,) = [i for i, (_, a, _) in enumerate(page.elements)
              if a.get("aria-label") == f"{metric} over control steps"]  # fmt: skip
    found, scale = [], ""
    for name, about, _ in page.elements[svg + 1 :]:
        if name == "svg":
            break
        scale = about["class"] if name == "g" else scale
        if name == "path" and scale == "scale linear":
            found.append(about)
    return found


# --- what it has ---


def test_two_groups_of_five_seeds(tmp_path):
    make_seeds(tmp_path / "runs", "a", [1.0, 2.0, 3.0, 4.0, 5.0], digests=["d1"], bit_exact=True)
    make_seeds(tmp_path / "runs", "b", [2.0, 3.0, 4.0, 5.0, 6.0], rate=1.0, bit_exact=False,
               inexact_because=["engine warp"])  # fmt: skip
    page = read(tmp_path, tmp_path / "runs")
    assert page.texts("h1") == ["walk: 10 runs"]
    assert "line faint c0 d0" in [a["class"] for a in paths(page, "eval/episode_return")]
    kinds = [about["class"].split()[0] for about in paths(page, "eval/episode_return")]
    assert kinds.count("line") == 10 and kinds.count("mean") == kinds.count("band") == 2
    means = [a for a in paths(page, "eval/episode_return") if a["class"].startswith("mean")]
    assert [a["class"] for a in means] == ["mean c0 d0", "mean c1 d0"]  # a colour for each group
    series = [s for panel in data(page) for s in panel if s["label"].endswith("IQM of 5")]
    assert series[0]["steps"] == [100, 200, 300, 400]
    assert series[0]["values"] == [0.75, 1.5, 2.25, 3.0]  # of 2, 3 and 4
    assert series[0]["low"][3] < 3.0 < series[0]["high"][3]
    rows = page.texts("tr")
    (row,) = [row for row in rows if row.startswith("a00done4 of 4400")]
    assert "yes" in row and "d1 (update 1)" in row
    assert any(r.startswith("b0") and "no: engine warp" in r for r in rows)
    assert any("P(better)" in r for r in rows) and "what differsppo.learning_rate" in rows
    assert "train/loss = 0.5" in "".join(page.texts("p"))  # a line of text instead of a flat curve


def test_a_run_that_is_its_group_stands_out_as_a_mean_does(tmp_path):
    make_seeds(tmp_path / "runs", "a", [1.0, 2.0])
    make_run(tmp_path / "runs" / "b", 1, [1.0, 2.0, 3.0, 4.0], rate=1.0)
    found = paths(read(tmp_path, tmp_path / "runs"), "eval/episode_return")
    kinds = [about["class"] for about in found if "band" not in about["class"]]
    assert kinds == ["line faint c0 d0", "line faint c0 d0", "line c1 d0", "mean c0 d0"]


def test_how_far_each_came(tmp_path):
    make_run(tmp_path / "runs" / "done", 1, [1.0] * 4)
    make_run(tmp_path / "runs" / "killed", 2, [1.0, 2.0])
    make_run(tmp_path / "runs" / "lost", 3, [2.0, None], more={"train/skipped_in_a_row": 10.0})
    make_run(tmp_path / "runs" / "young", 4, [])
    rows = page_rows = read(tmp_path, tmp_path / "runs").texts("tr")
    for name, state, updates in [
        ("done", "1done", "4 of 4"), ("killed", "2unfinished", "2 of 4"),
        ("lost", "3failed", "2 of 4"), ("young", "4unfinished", "0 of 4"),
    ]:  # fmt: skip
        assert any(row.startswith(name + state + updates) for row in rows), page_rows


def test_one_run_shows_its_spread_and_a_page_is_the_same_twice(tmp_path):
    folder = make_run(tmp_path / "a", 1, [1.0, 2.0, 3.0, 4.0])
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    spread = [line | {"eval/episode_return_std": 0.5} for line in lines]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in spread))
    page = read(tmp_path, folder)
    (series,) = data(page)[0]
    assert (series["low"], series["high"]) == ([0.5, 1.5, 2.5, 3.5], [1.5, 2.5, 3.5, 4.5])
    before = (tmp_path / "report.html").read_bytes()
    read(tmp_path, folder)
    assert (tmp_path / "report.html").read_bytes() == before


def test_nothing_is_fetched_and_one_script_may_run(tmp_path):
    page = read(tmp_path, make_run(tmp_path / "a", 1, [1.0] * 4))
    text = (tmp_path / "report.html").read_text()
    assert "http:" not in text and "https:" not in text and "@import" not in text
    (policy,) = [a["content"] for a, _ in page.find("meta") if "http-equiv" in a]
    assert "default-src 'none'" in policy and policy.count("sha256-") == 2
    assert "unsafe" not in policy
    assert not [a for _, a, _ in page.elements if any(name.startswith("on") for name in a)]
    assert not [a for _, a, _ in page.elements if "style" in a]  # the policy forbids them


def test_a_long_run_is_thinned_and_keeps_its_extremes(tmp_path):
    values = [float(i % 7) for i in range(5001)]
    steps, means, low, high = page_series.thin(range(1, 5002), values)
    assert len(steps) == len(means) <= 400 and steps[-1] == 5001
    assert min(low) == 0.0 and max(high) == 6.0
    assert means[0] == pytest.approx(sum(values[:13]) / 13)


def test_a_page_takes_so_many_charts_and_says_so(tmp_path):
    more = {f"train/m{i}": float(i) for i in range(350)}
    page = read(tmp_path, make_run(tmp_path / "a", 1, [1.0, 2.0], more=more))
    assert len(data(page)) == 300
    assert "52 more metrics have no chart" in "".join(page.texts("p"))  # of 350, return and loss


@pytest.mark.parametrize(
    "values", [[1e308, -1e308], [5e-324, 0.0], [1.0, 1.0 + 2e-16], [1e-300, 1e-301], [-3.0, -3.0]]
)
def test_odd_numbers_make_a_page(tmp_path, values):
    page = read(tmp_path, make_run(tmp_path / "a", 1, [*values, *values]))
    text = (tmp_path / "report.html").read_text()
    assert not re.search(r'="[^"]*\b(nan|inf)\b', text) and page.texts("h1")


def test_ticks_are_round_and_inside():
    for low, high in [(0, 1), (-3.7, 11), (936.2, 936.9), (1e-9, 2e-9), (-1e140, 1e149)]:
        found = page_charts.ticks(low, high)
        assert 2 <= len(found) <= 7 and low - 1e-9 * abs(low) <= found[0] < found[-1] <= high * 1.01
    assert page_charts.log_ticks(1e-5, 1e7) == [10.0**e for e in range(-4, 8, 2)]


# --- videos ---


def with_videos(folder: Path, **files: bytes) -> Path:
    (folder / "videos").mkdir()
    for name, content in files.items():
        (folder / "videos" / name.replace("__", ".")).write_bytes(content)
    return folder


def test_videos_and_sheets_are_inside(tmp_path):
    folder = make_run(tmp_path / "a", 1, [1.0] * 4)
    page = read(tmp_path, with_videos(folder, **{"004__mp4": MP4, "004__png": PNG}))
    (video, _), (sheet, _) = *page.find("video"), *page.find("img")
    assert video["src"].startswith("data:video/mp4;base64,AAAAIGZ0eXBpc29t")
    assert sheet["src"].startswith("data:image/png;base64,iVBORw0KGgpzaGVldA==")


def test_a_link_a_pipe_and_what_is_no_picture_are_left_out(tmp_path, monkeypatch):
    secret = tmp_path / "secret.png"
    secret.write_bytes(PNG + b"of the reader")
    folder = with_videos(
        make_run(tmp_path / "a", 1, [1.0] * 4), **{"3__png": b"<svg onload=alert(1)>"}
    )
    (folder / "videos" / "2.png").symlink_to(secret)
    (folder / "videos" / "1.png").write_bytes(PNG * 20)
    os.mkfifo(folder / "videos" / "4.mp4")
    monkeypatch.setattr(page_media, "LARGEST", 100)
    page = read(tmp_path, folder)
    assert not page.find("img") and not page.find("video")
    said = [text for text in page.texts("p") if text.startswith("Left out")]
    assert len(said) == 4
    for line, part in zip(said, ["no regular file", "no image/png", "leaves the run", "260 bytes"],
                          strict=True):  # fmt: skip
        assert part in line


def test_a_page_has_no_folder_of_ours(tmp_path):
    home, there = tmp_path / "my home" / "secret", "/home/secret"
    more = {"experiment_file": f"{home}/mine.py", "flags": {"XLA_FLAGS": f"--dump={there}/a.txt"}}
    folders = [make_run(home / f"{seed}", seed, [1.0] * 4, **more) for seed in (1, 2)]
    with_videos(folders[0], **{"1__png": b"no png, and told with its path"})
    page = make_page(run_reader.read_runs(folders, "report"))
    assert "secret" not in page and str(tmp_path) not in page
    assert "--dump=a.txt" in page and "1.png is no image/png" in page


def test_a_draft_that_is_a_link_is_not_written_through(tmp_path):
    target, folder = tmp_path / "target", make_run(tmp_path / "a", 1, [1.0] * 4)
    (tmp_path / ".report.html.draft").symlink_to(target)
    read(tmp_path, folder)
    assert not target.exists()


# --- a stranger's folder ---


def strangers(place: Path) -> Path:
    """Runs with a script wherever a file can have text."""
    ramp = [1.0, 2.0, 3.0, 4.0]
    for seed, rate in ((1, 1e-3), (2, 1.0)):
        more = {
            EVIL: 1.0,
            f"train/{EVIL}": 2.0,
            f"eval/{QUOTED}": 3.0,
            f"train/episode/{QUOTED}": 4.0,
        }
        folder = make_run(
            place / f"{seed}{QUOTED.replace('/', '')}", seed, ramp, rate, experiment=EVIL,
            digests=[f"</script>{EVIL}"], more=more, engine=QUOTED, bit_exact=False,
            inexact_because=[EVIL], device={"kind": EVIL}, **{EVIL: {QUOTED: EVIL}},
        )  # fmt: skip
        with_videos(folder, **{f"4{QUOTED.replace('/', '')}__png": PNG})
        lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
        changed = [line | {f"train/{EVIL}": float(i)} for i, line in enumerate(lines)]
        (folder / "metrics.jsonl").write_text("".join(json.dumps(c) + "\n" for c in changed))
        config = json.loads((folder / "config.json").read_text())
        config["settings"][f"env{EVIL}"] = {QUOTED: f"{EVIL}{seed}\x1b[2J\u202e"}
        (folder / "config.json").write_text(json.dumps(config))
    return place


def test_what_comes_from_files_is_text(tmp_path):
    page = read(tmp_path, strangers(tmp_path / "runs"))
    assert len(page.find("script")) == 2 and all("src" not in a for a, _ in page.find("script"))
    assert not [a for _, a, _ in page.elements if any(name.startswith("on") for name in a)]
    assert all(a["src"].startswith("data:image/png;") for a, _ in page.find("img"))
    assert EVIL in "".join(page.texts("h1")) and EVIL in "".join(page.texts("figcaption"))
    text = (tmp_path / "report.html").read_text()
    assert "\x1b" not in text and "\u202e" not in text and text.count("</script>") == 2


def test_only_html_is_not_escaped():
    assert html_elements.text(EVIL) == "&lt;script&gt;alert(1)&lt;/script&gt;"
    cell = html_elements.element("td", EVIL, title=QUOTED)
    assert "<script" not in cell and "<img" not in cell and cell.count('"') == 2
    assert html_elements.text(cell) is cell


def test_a_page_is_made_without_jax(tmp_path):
    make_seeds(tmp_path / "runs", "a", [1.0, 2.0], digests=["d1"])
    (tmp_path / "runs" / "a0" / "experiment.py").write_text("raise SystemExit('executed')")
    heavy = "('jax', 'jaxlib', 'flax', 'mujoco', 'matplotlib')"
    code = (
        "import sys; from purerl.__main__ import main; code = main(['report', *sys.argv[1:]]); "
        f"assert not set({heavy}) & set(sys.modules), 'heavy'; sys.exit(code)"
    )
    words = [sys.executable, "-c", code, str(tmp_path / "runs"), "--out", str(tmp_path / "r.html")]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert "2 runs" in done.stdout and (tmp_path / "r.html").exists()


def test_a_mistake_is_one_line(tmp_path, capsys):
    runs = str(make_run(tmp_path / "a", 1, [1.0] * 4))
    for words, part in [
        ([], "Give the runs"),
        ([str(tmp_path / "nowhere")], "no run"),
        ([runs, "--group-by", "ppo.lerning_rate"], "Did you mean 'ppo.learning_rate'?"),
        ([runs, "--out", str(tmp_path)], "is a folder"),
        ([runs, "--out", str(tmp_path / "no" / "r.html")], "cannot be written"),
    ]:
        assert report.main(words) == USAGE, words
        assert part in only_line(capsys)


# --- in a browser ---

needs_chromium = pytest.mark.skipif(
    chromium.find() is None, reason="no Chromium here: apt-get install chromium"
)
SHOWN = (
    "[...document.querySelectorAll('{}')].filter(e => getComputedStyle(e).display != 'none').length"
)


@pytest.mark.slow
@needs_chromium
def test_clicks_change_the_page_and_nothing_complains(tmp_path):
    make_seeds(tmp_path / "runs", "a", [1.0, 2.0, 3.0])
    make_seeds(tmp_path / "runs", "b", [2.0, 3.0, 4.0], rate=1.0)
    read(tmp_path, tmp_path / "runs")
    lines = SHOWN.format(".scale.linear path.line, .scale.linear path.mean")
    with chromium.browser() as browser:
        browser.open(tmp_path / "report.html")
        assert browser.value(lines) == 8  # six runs, two means
        browser.click('input[data-key="0/1"]')
        assert browser.value(lines) == 7
        browser.click('input[data-key="1/mean"]')  # with its runs
        assert browser.value(lines) == 3
        browser.click('input[data-key="1/mean"]')
        assert browser.value(lines) == 7
        browser.point('figure[data-panel="0"] svg', 0.999)
        said = browser.value("document.getElementById('tip').innerText")
        assert said.startswith("400 steps") and "b2: 4" in said and "a1" not in said
        assert browser.value(SHOWN.format("g.scale.log")) == 0
        browser.click("#log")
        assert browser.value(SHOWN.format("g.scale.log")) == 1
        assert browser.value(SHOWN.format("g.scale.linear")) == 0
        colors = []
        for scheme in ("light", "dark"):
            browser.media(scheme)
            colors.append(browser.value("getComputedStyle(document.body).backgroundColor"))
        assert colors == ["rgb(255, 255, 255)", "rgb(20, 23, 26)"]
        assert browser.said == []
        assert all(url.startswith(("data:", "file:")) for url in browser.requested)


@pytest.mark.slow
@needs_chromium
def test_a_strangers_page_runs_no_script_of_his(tmp_path):
    read(tmp_path, strangers(tmp_path / "runs"))
    with chromium.browser() as browser:
        browser.open(tmp_path / "report.html")
        browser.point('figure[data-panel="0"] svg', 0.9)
        assert EVIL in browser.value("document.body.innerText")
        assert browser.value("document.scripts.length") == 2
        assert browser.said == [] and not [
            e for e in browser.events if e.get("method") == "Page.javascriptDialogOpening"
        ]
