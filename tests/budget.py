"""Prints how much code there is, and how that changed since another commit.

    python -m tests.budget           # since this branch left `main`
    python -m tests.budget HEAD~3

A line counts if it has code on it. Blank lines, comments and docstrings are free, because a limit
on them would punish who explains. A string below a setting is printed by `--help`, so it is no
docstring and counts. The links `purerl/envs`, `purerl/experiments` and `purerl/assets` lead out of
`purerl/`, so what they lead to does not count.
"""

import argparse
import ast
import io
import subprocess
import sys
import tarfile
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
MOST_OF_THE_ALGORITHM = 1100
MOST_OF_THE_KERNEL = 2313  # `exact/kernel`, and 40 lines where it is used
MOST_OF_ALL = 15332 + MOST_OF_THE_KERNEL
FREE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
FREE |= {tokenize.ENCODING, tokenize.ENDMARKER}
DOCUMENTED = ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef


class Size(NamedTuple):
    """How long some files are, in lines."""

    code: int
    comments: int  # lines that hold nothing but a comment
    lines: int
    longest: tuple[int, str]  # of the functions: its lines of code, and its name

    @property
    def share(self) -> float:
        """Comments among all lines."""
        return self.comments / self.lines if self.lines else 0.0


# --- the sources: module -> text ---


def of_this_folder(root: Path = ROOT) -> dict[str, str]:
    """Returns the modules of `purerl/` as they are now."""
    paths = [path for path in (root / "purerl").rglob("*.py") if not path.is_symlink()]
    return {name_of(str(path.relative_to(root))): path.read_text() for path in paths}


def of_commit(commit: str, root: Path = ROOT) -> dict[str, str]:
    """Returns the modules of `purerl/` as they were in a commit."""
    packed = subprocess.run(
        ["git", "archive", commit, "purerl"], cwd=root, capture_output=True, check=True
    )
    found = {}
    with tarfile.open(fileobj=io.BytesIO(packed.stdout)) as archive:
        for member in archive:
            if member.isfile() and member.name.endswith(".py"):
                text = archive.extractfile(member)
                assert text is not None
                found[name_of(member.name)] = text.read().decode()
    return found


def name_of(path: str) -> str:
    """Returns the module that `path`, such as "purerl/ppo/losses.py", holds."""
    return ".".join(Path(path).with_suffix("").parts).removesuffix(".__init__")


# --- what stands on what ---


def imported(text: str) -> Iterator[str]:
    """Yields every module that a file's import statements name, wherever they stand."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def algorithm(sources: dict[str, str]) -> set[str]:
    """Returns the modules of the room `ppo` and all of purerl that they import."""
    todo = [name for name in sources if room_of(name) == "ppo"] + ["purerl.core"]
    found: set[str] = set()
    while todo:
        name = todo.pop()
        if name not in found:
            found.add(name)
            todo += {n for n in imported(sources[name]) if n in sources} - {"purerl"}
    return found


def room_of(name: str) -> str:
    """Returns the room that a module is in; "" for a command, which stands beside the rooms."""
    parts = name.split(".")
    return parts[1] if len(parts) > 2 else ""


# --- counting ---


def code_lines(text: str) -> set[int]:
    """Returns the numbers of the lines that have code on them."""
    found: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in FREE:
            found |= set(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            docstring = node.body[0]
            assert docstring.end_lineno is not None
            found -= set(range(docstring.lineno, docstring.end_lineno + 1))
    return found


def measure(texts: dict[str, str]) -> Size:
    """Returns the size of some modules together; name -> text."""
    code = comments = lines = 0
    longest = 0, ""
    for name, text in texts.items():
        coded = code_lines(text)
        code, lines = code + len(coded), lines + len(text.splitlines())
        comments += sum(line.strip().startswith("#") for line in bare_lines(text))
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                assert node.end_lineno is not None
                length = len(coded & set(range(node.lineno, node.end_lineno + 1)))
                longest = max(longest, (length, f"{name}.{node.name}"))
    return Size(code, comments, lines, longest)


def bare_lines(text: str) -> list[str]:
    """Returns the lines that are not inside a long string, where # begins no comment."""
    lines = dict(enumerate(text.splitlines(), 1))
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in FREE and token.end[0] > token.start[0]:
            for number in range(token.start[0] + 1, token.end[0] + 1):
                lines.pop(number, None)
    return list(lines.values())


def measure_all(sources: dict[str, str]) -> dict[str, Size]:
    """Returns the sizes of the algorithm, of each room, of the commands and of all."""
    standing = algorithm(sources)
    rooms = sorted({f"purerl.{room_of(n)}" for n in sources if room_of(n)})

    def of_room(room: str) -> dict[str, str]:
        return {n: text for n, text in sources.items() if n == room or n.startswith(f"{room}.")}

    beside = {n: text for n, text in sources.items() if not room_of(n) and n not in rooms}
    return {
        "the algorithm": measure({n: sources[n] for n in standing}),
        **{room.removeprefix("purerl."): measure(of_room(room)) for room in rooms},
        "commands": measure(beside),
        "purerl/": measure(sources),
    }


def main() -> int:
    """Prints the table; returns 1 if a limit is broken."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.budget",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("commit", nargs="?", help="what to compare with; else where main was left")
    commit = parser.parse_args().commit or merge_base()
    now, before = measure_all(of_this_folder()), measure_all(of_commit(commit))
    limits = {"the algorithm": MOST_OF_THE_ALGORITHM, "purerl/": MOST_OF_ALL}
    print(f"Lines of code, the change since {commit[:12]}, and comments on lines of their own:")
    for name, size in now.items():
        change = size.code - before[name].code if name in before else size.code
        most = f"at most {limits[name]:,}" if name in limits else ""
        length, where = size.longest
        print(
            f"{name:14}{size.code:8,}{change:+8,}  {most:15} {size.comments:5} comments"
            f" {size.share:6.1%}  longest function {length:3}: {where}"
        )
    for name in before.keys() - now.keys():
        print(f"{name:14}{0:8}{-before[name].code:+8,}  gone")
    broken = [name for name, most in limits.items() if now[name].code > most]
    print(f"Above its limit: {', '.join(broken)}." if broken else "Within the limits.")
    return 1 if broken else 0


def merge_base() -> str:
    """Returns the commit where this branch left `main`; on `main` itself, the one before."""

    def ask(*words: str) -> str:
        done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True)
        return done.stdout.strip()

    base = next(filter(None, (ask("merge-base", x, "HEAD") for x in ("main", "origin/main"))), "")
    return base if base and base != ask("rev-parse", "HEAD") else ask("rev-parse", "HEAD~")


if __name__ == "__main__":
    sys.exit(main())
