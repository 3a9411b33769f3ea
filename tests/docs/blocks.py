"""The code blocks of the pages, and what a page says about running them.

Directly above a block may stand `<!-- not run: REASON -->`, or, above bash,
`<!-- run with: WORDS -->`: these words are added to the block's last command, or
`<!-- needs: MODULE ... -->`: without these modules the block is left out. A block with
`title="FILE"` after its language is written to that file instead of executed.

`<!-- given: FOLDER -->` anywhere in a page: it begins with that run of the cart-pole in its folder.
"""

import importlib.util
import re
import textwrap
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent.parent
EXECUTED = ("bash", "python")
SHOWN = ("diff", "json", "text", "toml", "xml", "yaml")
FENCE = re.compile(r"^( *)```(.*)$")
MARKER = re.compile(r"^ *<!-- (not run|run with|needs): (\S.*?) *-->$")
GIVEN = re.compile(r"^<!-- given: (\S+) -->$", re.MULTILINE)
TITLE = re.compile(r'^title="([\w./-]+)"$')
COMMENT = re.compile(r"\s+#[^'\"]*$")


class Block(NamedTuple):
    """A fenced block: where its code begins, its language, and what stands about it."""

    line: int  # of the first line of code, from 1
    language: str
    title: str  # of the file to write, or nothing
    marker: str  # "not run", "run with", "needs" or nothing
    words: str  # of the marker
    code: str

    @property
    def runs(self) -> bool:
        """Tells whether it is executed, or written, where the modules that it needs are."""
        return self.language in EXECUTED and self.marker != "not run"

    @property
    def lacks(self) -> list[str]:
        """Returns the modules that it needs and that are not here."""
        needed = self.words.split() if self.marker == "needs" else []
        return [name for name in needed if importlib.util.find_spec(name) is None]


def pages() -> dict[str, Path]:
    """Returns the pages whose blocks are executed, by their path in the clone."""
    found = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return {str(path.relative_to(ROOT)): path for path in found}


def blocks(text: str) -> list[Block]:
    """Returns the fenced blocks of a page, those inside lists too; refuses one that has no end."""
    lines = text.splitlines()
    found, number = [], 0
    while number < len(lines):
        fence = FENCE.match(lines[number])
        if fence:
            end = _end(lines, number, fence[1])
            found.append(_block(lines, number, end))
            number = end
        number += 1
    return found


def _end(lines: list[str], start: int, indent: str) -> int:
    for number in range(start + 1, len(lines)):
        if lines[number].rstrip() == f"{indent}```":
            return number
    raise ValueError(f"line {start + 1}: the block has no end: write ``` on a line of its own.")


def _block(lines: list[str], start: int, end: int) -> Block:
    language, _, rest = lines[start].strip().removeprefix("```").partition(" ")
    title = TITLE.match(rest)
    if rest and not title:
        raise ValueError(f'line {start + 1}: {rest!r} after the language: write title="FILE".')
    marker = MARKER.match(lines[start - 1]) if start else None
    said = (marker[1], marker[2]) if marker else ("", "")
    code = textwrap.dedent("\n".join(lines[start + 1 : end]) + "\n")
    return Block(start + 2, language, title[1] if title else "", *said, code)


def lone_markers(text: str) -> list[int]:
    """Returns the lines of markers that are empty, misspelt, or not directly above a block."""
    lines = text.splitlines()
    return [
        number + 1
        for number, line in enumerate(lines)
        if re.match(r" *<!-- *(not run|run with|needs)", line)
        and not (MARKER.match(line) and FENCE.match([*lines, ""][number + 1]))
    ]


def command(block: Block) -> str:
    """Returns the bash to execute: the code, with the marker's words after its last command."""
    lines = block.code.rstrip().splitlines()
    while lines and lines[-1].lstrip().startswith("#"):
        lines.pop()
    if block.marker == "run with":
        lines[-1] = f"{COMMENT.sub('', lines[-1])} {block.words}"
    return "\n".join(lines)
