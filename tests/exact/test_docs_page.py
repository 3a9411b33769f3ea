"""The page `docs/howto/exact.md` runs as it stands, and prints what it says."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests import quick
from tests.exact.kernel import needs_compiler

ROOT = Path(__file__).parents[2]


def blocks(kind):
    return re.findall(rf"```{kind}\n(.*?)```", (ROOT / "docs/howto/exact.md").read_text(), re.S)


@needs_compiler
@pytest.mark.slow
def test_the_pages_code_prints_what_the_page_says():
    program = "\n".join(blocks("python"))
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": quick.FLAGS}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, env=environment, cwd=ROOT
    )
    assert not done.returncode, done.stderr
    said = done.stdout[done.stdout.index("scatter-add") :]  # importing MJX may print before
    assert said == "".join(blocks("text"))


def test_the_page_names_the_flags_that_are_set():
    from purerl.exact import xla_flags

    page = (ROOT / "docs/howto/exact.md").read_text()
    for name, value in (xla_flags.RULES | xla_flags.GRAPHS).items():
        assert f"--{name}={value}" in page
