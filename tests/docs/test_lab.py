"""The log of measurements: dated entries, all of them in its index, newest first."""

import datetime
import re

from tests.docs.blocks import ROOT

LAB = ROOT / "lab"
ENTRIES = sorted(path for path in LAB.glob("*.md") if path.name != "README.md")
ROW = re.compile(r"^\| (\d+ \w+ \d+) \| \[(.+)\]\(([\w.-]+)\) \| .+ \|$", re.MULTILINE)
LINK = re.compile(r"\]\(([^)#\s]*)(?:#[^)]*)?\)")


def written(path):
    """Returns the date of an entry's name as its text has it: 28 November 2026."""
    day = datetime.date.fromisoformat(path.name[:10])
    return f"{day.day} {day:%B %Y}"


def test_an_entry_begins_with_its_title_and_the_date_of_its_name():
    assert len(ENTRIES) > 30
    for path in ENTRIES:
        title, empty, head = path.read_text().splitlines()[:3]
        assert title.startswith("# ") and not empty, path
        assert head.startswith(f"*{written(path)}. "), path


def test_the_index_has_every_entry_once_newest_first_under_its_title():
    rows = ROW.findall((LAB / "README.md").read_text())
    assert sorted(name for _, _, name in rows) == [path.name for path in ENTRIES]
    days = [name[:10] for _, _, name in rows]
    assert days == sorted(days, reverse=True)
    for date, title, name in rows:
        day = datetime.date.fromisoformat(name[:10])
        assert date == f"{day.day} {day:%b %Y}", name
        assert (LAB / name).read_text().startswith(f"# {title}\n"), name


def test_links_of_the_log_lead_to_files():
    """Within the log: pages move, and nobody edits an entry."""
    for path in ENTRIES:
        for link in LINK.findall(path.read_text()):
            assert link.startswith("http") or (LAB / link).exists(), f"{path.name}: {link}"
            assert not link.startswith(".."), f"{path.name}: {link}"
