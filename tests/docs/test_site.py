"""The site has every page, builds without a warning, and loads nothing from elsewhere."""

import ast
import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import purerl
from purerl.__main__ import COMMANDS
from tests.docs import generated, notebook, site
from tests.docs.blocks import ROOT, blocks, pages
from tests.mistakes.play import read_table

DOCS = ROOT / "docs"
NOTEBOOKS = sorted(DOCS.rglob("*.ipynb"))
# What a browser fetches by itself; a link that a reader follows is none of it.
LOADS = re.compile(r"""<(?:script|img|link|iframe)[^>]*(?:src|href)=["']?(?:https?:)?//""")
FETCHED = re.compile(r"""url\(["']?(?:https?:)?//|@import ["'](?:https?:)?//""")


def test_every_page_is_in_the_navigation_and_the_other_way_round():
    listed = re.findall(r"^ +- (?:[\w ]+: )?([\w/]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.M)
    there = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}
    there |= {path.relative_to(DOCS).with_suffix(".md").as_posix() for path in NOTEBOOKS}
    assert not there & set(generated.OF_THE_SITE), "made when the site is built: no files"
    there |= set(generated.OF_THE_SITE)
    assert sorted(listed) == sorted(there | set(site.OUTSIDE))


def used_names() -> set[str]:
    """Returns the public names that executed blocks use: `purerl.NAME`, or imported and named."""
    used = set()
    for path in pages().values():
        for block in blocks(path.read_text()):
            if block.language == "python" and block.runs:
                tree = ast.parse(block.code)
                imported = {
                    alias.name
                    for node in ast.walk(tree)
                    if isinstance(node, ast.ImportFrom) and node.module == "purerl"
                    for alias in node.names
                }
                named = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name)}
                used |= imported & named
                used |= {
                    node.attr
                    for node in ast.walk(tree)
                    if isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "purerl"
                }
    return used


def test_every_public_name_has_an_example_that_runs():
    assert not set(purerl.__all__) - used_names()


def test_every_public_name_has_its_docstring_in_the_reference():
    asked = set()
    for path in (DOCS / "reference").glob("*.md"):
        asked |= set(site.DOCSTRING.findall(path.read_text()))
    # Packages with pages of their own, and names of types.
    assert asked == set(purerl.__all__) - {
        "adapters",
        "clips",
        "exact",
        "planner",
        "Array",
        "PyTree",
    }


def test_every_command_is_in_the_overview():
    overview = (DOCS / "reference/commands.md").read_text()
    assert not [name for name in COMMANDS if f"| `purerl.{name}` |" not in overview]


def test_settings_are_written_from_the_code():
    message = "run `python -m tests.docs --write`"
    assert generated.SETTINGS.read_text() == generated.settings(), message


@pytest.mark.slow
def test_the_page_of_options_has_the_help_of_every_command():
    page = generated.commands()
    heads = re.findall(r"^## (\w+)\n\n```text\n\S", page, re.MULTILINE)
    assert heads == list(COMMANDS)
    assert "--ppo.gamma" in page


def test_the_page_of_mistakes_quotes_the_table():
    page = generated.OF_THE_SITE["reference/mistakes.md"]()
    quoted = " ".join(line.removeprefix("> ") for line in page.splitlines() if line[:2] == "> ")
    for mistake in read_table():
        assert f"**{mistake.title}**" in page
        assert mistake.says in quoted


@pytest.mark.parametrize(
    ("link", "here", "there"),
    [
        ("../../CONTRIBUTING.md", "docs/howto/a.md", "../CONTRIBUTING.md"),
        ("../explanation/bits.md", "docs/howto/a.md", "../explanation/bits.md"),
        ("docs/howto/a.md", "CHANGELOG.md", "howto/a.md"),
        ("tutorials/n.ipynb", "docs/README.md", "tutorials/n.md"),
        ("rodent.jpg", "docs/README.md", "rodent.jpg"),
        ("../../tests/mistakes/table.toml", "docs/howto/a.md", "../reference/mistakes.md"),
    ],
)
def test_links_lead_to_the_same_page_on_github_and_in_the_site(link, here, there):
    assert site.in_site(link, here) == there


@pytest.mark.parametrize(
    ("link", "shown"),
    [
        ("[the log](../../lab/README.md#words)", "the log (`lab/README.md`)"),
        ("[lab](lab/README.md)", "lab (`lab/README.md`)"),
        ("[`envs/run.py`](../envs/run.py)", "`envs/run.py`"),
        ("[results](../explanation/results.md)", "[results](../explanation/results.md)"),
    ],
)
def test_a_link_to_what_the_site_has_not_becomes_its_path(link, shown):
    assert site.CODE.sub(lambda m: site.path_of(m[1], m[2]), link) == shown


def test_a_notebook_keeps_what_it_prints_and_draws(monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    draw = "import matplotlib.pyplot as plt\nplt.plot([1, 2]);"
    sources = ["x = 2\nprint('said')\nx + 1", draw, "x = x"]
    cells = [{"cell_type": "code", "source": [source]} for source in sources]
    done = notebook.execute({"cells": cells})["cells"]
    assert [[o["output_type"] for o in cell["outputs"]] for cell in done] == [
        ["stream", "execute_result"], ["display_data"], [],
    ]  # fmt: skip
    page = site.page_of_notebook(json.dumps({"cells": done}))
    assert "```text\nsaid\n```" in page and "```text\n3\n```" in page and "data:image/png" in page


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_is_kept_executed_and_small(path):
    assert path.stat().st_size < 200_000
    found = [c for c in json.loads(path.read_text())["cells"] if c["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in found] == list(range(1, len(found) + 1))
    assert sum(bool(cell["outputs"]) for cell in found) > len(found) / 2


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_runs(path, tmp_path, monkeypatch):
    """With fewer steps."""
    short = tmp_path / path.name
    short.write_text(re.sub(r"num_steps\\\": [\d_]+", 'num_steps\\": 20_000', path.read_text()))
    assert short.read_text() != path.read_text()
    words = [sys.executable, "-m", "tests.docs.notebook", str(short)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.skipif(not importlib.util.find_spec("mkdocs"), reason="needs the extra docs")
def test_the_site_builds_without_a_warning_and_loads_nothing_from_elsewhere(tmp_path):
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    # A notice of mkdocs-material about the years to come.
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, env=environment)
    assert done.returncode == 0 and "WARNING" not in done.stderr, done.stderr
    html = sorted(tmp_path.rglob("*.html"))
    assert len(html) > 25
    for path in html:
        assert not LOADS.search(path.read_text()), path
    for path in tmp_path.rglob("*.css"):
        assert not FETCHED.search(path.read_text()), path
    # Docstrings are there, and no comment of ours is left.
    text = (tmp_path / "reference/training.html").read_text()
    assert "the path of a Python file, or a dotted module" in text and "docstring:" not in text
    assert (tmp_path / "CONTRIBUTING.html").exists()
    # Pages that are made from the code, and no link into the log, which is not there.
    assert "--checkpoints" in (tmp_path / "reference/options.html").read_text()
    assert "Did you mean" in (tmp_path / "reference/mistakes.html").read_text()
    assert not [path for path in html if re.search(r'href="[^"]*lab/', path.read_text())]
    assert "data:image/png" in Path(tmp_path, "tutorials/notebook.html").read_text()
