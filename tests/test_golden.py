"""Short runs end with the bits that they ended with when their digests were written down."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

GOLDEN = Path(__file__).parent / "golden"
TABLE = json.loads((GOLDEN / "digests.json").read_text())


@pytest.mark.parametrize("name", sorted(TABLE))
def test_bits_are_those_of_the_table(name):
    """After a change of bits that is meant: python -m tests.golden --write, and CHANGELOG."""
    words = [sys.executable, "-m", "tests.golden", name]
    done = subprocess.run(words, cwd=GOLDEN.parent.parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
