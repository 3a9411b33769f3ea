"""Command lines from dataclasses, by tyro, with one-line errors."""

import contextlib
import difflib
import io
import re
from collections.abc import Sequence
from typing import Any

import tyro

from purerl.errors import UserError

CONFIG = (tyro.conf.FlagCreatePairsOff,)


def parse(kind: Any, arguments: Sequence[str], prog: str, default: Any = None) -> Any:
    """Parses a command line into the dataclass `kind`; `--help` prints a page and exits.

    Raises:
      UserError: an option that there is not, with the nearest there is, or a value that is wrong.
    """
    extra = {} if default is None else {"default": default}
    if not {"-h", "--help"} & set(arguments):
        _check_options(tyro.extras.get_parser(kind, config=CONFIG, **extra), arguments, prog)
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(kind, args=list(arguments), prog=prog, config=CONFIG, **extra)
    except SystemExit as error:
        if not error.code:
            raise
        raise UserError(f"{_plain(said.getvalue())} ({prog} --help)") from error
    except ValueError as error:  # a rule across fields, from a __post_init__
        raise UserError(str(error)) from error


def _check_options(parser: Any, arguments: Sequence[str], prog: str) -> None:
    valid = sorted(flag for flag in parser._option_string_actions if flag.startswith("--"))
    for word in arguments:
        flag = word.split("=", 1)[0].replace("_", "-")
        if word.startswith("--") and len(word) > 2 and flag not in valid:
            near = difflib.get_close_matches(flag, valid, n=1, cutoff=0.4)
            hint = f" Did you mean {near[0]}?" if near else ""
            raise UserError(f"There is no option {flag}.{hint} All of them: {prog} --help")


def _plain(text: str) -> str:
    """Returns tyro's framed, coloured message as one line."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", text)
    lines = [re.sub(r"[─-╿]+", " ", line).strip() for line in text.splitlines()]
    plain = " ".join(" ".join(lines).split())
    plain = re.sub(
        r"^(Value error|Missing argument|Unrecognized options|Parsing error) ", "", plain
    )
    plain = re.sub(r"^Error parsing \w+: ", "", plain)  # a rule of a dataclass, in its own words
    plain = re.sub(r" *(Argument helptext:|For full helptext).*", "", plain)
    return plain or "The command line is wrong."
