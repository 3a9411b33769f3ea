"""Command lines from dataclasses, by tyro, with one-line errors."""

import contextlib
import io
import re
from collections.abc import Sequence
from typing import Any

import tyro

from purerl.core.errors import UserError

CONFIG = (tyro.conf.FlagCreatePairsOff,)


def parse(kind: Any, arguments: Sequence[str], prog: str, default: Any = None) -> Any:
    """Parses a command line into the dataclass `kind`; `--help` prints a page and exits.

    Raises:
      UserError: an option that there is not, with the nearest there is, or a value that is wrong.
    """
    extra = {} if default is None else {"default": default}
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(kind, args=list(arguments), prog=prog, config=CONFIG, **extra)
    except SystemExit as error:
        if not error.code:
            raise
        raise UserError(f"{one_line(said.getvalue())} All options: {prog} --help") from error


def one_line(text: str) -> str:
    """Returns tyro's framed, coloured message as one line: what is wrong, and the nearest fix."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", text)
    plain = " ".join(re.sub(r"[─-╿]", " ", text).split())
    unknown = re.search(r"Unrecognized options: (\S+?)[,=]? ", plain)
    if unknown:
        near = re.search(r"(?:meant:|similar to \S+:) (--\S+)", plain)
        return f"There is no option {unknown[1]}." + (f" Did you mean {near[1]}?" if near else "")
    titles = "Value error|Missing argument|Invalid choice|Parsing error|Required options"
    plain = re.sub(rf"^({titles}) ", "", plain)
    plain = re.sub(r"^Error parsing \w+: ", "", plain)  # a rule of a dataclass, in its own words
    plain = re.sub(r" *(Argument helptext:|For full helptext).*", "", plain)
    return plain.rstrip(".") + "." if plain else "The command line is wrong."
