"""Prints the page of mistakes: `python -m tests.mistakes`; `--write` writes it into docs/."""

import sys

from tests.mistakes.play import ROOT, page

if "--write" in sys.argv[1:]:
    (ROOT / "docs/reference/mistakes.md").write_text(page())
else:
    print(page())
