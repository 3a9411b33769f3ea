"""The `type` of an argument that names a file to write, or is a count."""

import argparse
from pathlib import Path

from purerl.core.errors import UserError
from purerl.machine.files import check_writable


def output_file(name: str) -> str:
    """Checks the name of a file to write, "" for none; the `type` of an argument of argparse.

    Raises:
      argparse.ArgumentTypeError: it cannot be written, which is better known before measuring.
    """
    try:
        if name:
            check_writable(Path(name))
    except UserError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return name


def count(text: str) -> int:
    """Reads a whole number of at least 1; the `type` of an argument of argparse."""
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"{text} is no count: give a whole number of at least 1.")
    return int(text)
