"""Prints which blocks of the pages are executed.

`python -m tests.docs PAGE...` executes pages; `--since COMMIT` those whose code is no longer that
commit's; `--write` writes docs/reference/settings.md.
"""

import subprocess
import sys
import time
from pathlib import Path

from tests.docs import generated
from tests.docs.blocks import EXECUTED, ROOT, blocks, pages
from tests.docs.play import run


def main() -> None:
    if sys.argv[1:] == ["--write"]:
        generated.SETTINGS.write_text(generated.settings())
        return
    if sys.argv[1:2] == ["--since"]:
        sys.exit(max(map(_executed, changed_since(sys.argv[2])), default=0))
    if sys.argv[1:]:
        sys.exit(max(_executed(Path(name)) for name in sys.argv[1:]))
    ran = written = 0
    left = []
    for name, path in pages().items():
        for block in blocks(path.read_text()):
            written += bool(block.title)
            ran += block.runs and not block.title and not block.lacks
            if block.language in EXECUTED and block.marker == "not run":
                left.append(f"  {name}:{block.line}: {block.words}")
            elif block.lacks:
                left.append(f"  {name}:{block.line}: {', '.join(block.lacks)} is not installed")
    print(f"blocks executed: {ran}; written to files: {written}; not executed: {len(left)}")
    print(*left, sep="\n")


def changed_since(commit: str) -> list[Path]:
    """Returns the pages that execute something else than they did at a commit."""
    return [
        path
        for name, path in pages().items()
        if _code(path.read_text()) not in ([], _code(_page_at(commit, name)))
    ]


def _code(text: str) -> list[tuple[str, ...]]:
    return [(b.language, b.title, b.marker, b.words, b.code) for b in blocks(text) if b.runs]


def _page_at(commit: str, name: str) -> str:
    """Returns a page's text at a commit; nothing, where the commit has no such page."""
    words = ["git", "show", f"{commit}:{name}"]
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True).stdout


def _executed(page: Path) -> int:
    """Executes a page; prints what it prints, and how long it took."""
    start = time.monotonic()
    done = run(page)
    print(done.stdout + done.stderr)
    shown = page.resolve()
    shown = shown.relative_to(ROOT) if shown.is_relative_to(ROOT) else shown
    print(f"{shown}: exit code {done.returncode}, {time.monotonic() - start:.0f} s")
    return done.returncode


if __name__ == "__main__":
    main()
