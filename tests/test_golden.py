"""Short runs end with the bits that they ended with when their digests were written down."""

import json
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

GOLDEN = Path(__file__).parent / "golden"
TABLE = json.loads((GOLDEN / "digests.json").read_text())
QUICK = ("cartpole", "statistics")
MARKS = {False: (), True: pytest.mark.slow}


@cache
def computed(slow: bool) -> dict[str, str]:
    """Computes the digests of the quick or of the slow runs; returns name -> what was found."""
    names = [name for name in TABLE if (name not in QUICK) == slow]
    words = [sys.executable, "-m", "tests.golden", *names]
    done = subprocess.run(words, cwd=GOLDEN.parent.parent, capture_output=True, text=True)
    found = [line for line in done.stdout.splitlines() if line.startswith(tuple(names))]
    assert len(found) == len(names), done.stdout + done.stderr
    return {line.split()[0]: line for line in found}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=MARKS[name not in QUICK]) for name in sorted(TABLE)]
)
def test_bits_are_those_of_the_table(name):
    """After a change of bits that is meant: python -m tests.golden --write, and CHANGELOG."""
    found = computed(name not in QUICK)[name]
    assert found.startswith(f"{name} same"), found
