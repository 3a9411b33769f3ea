"""Prints the page of mistakes: `python -m tests.mistakes`; `--write` writes docs/mistakes.md."""

import sys

from tests.mistakes.play import ROOT, page

if "--write" in sys.argv[1:]:
    (ROOT / "docs" / "mistakes.md").write_text(page())
else:
    print(page())
