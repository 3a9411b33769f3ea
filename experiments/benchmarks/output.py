"""The `type` of an argument that names a file to write, or is a count."""

import argparse
import os
from pathlib import Path


def output_file(name: str) -> str:
    """Checks the name of a file to write, "" for none; the `type` of an argument of argparse.

    Raises:
      argparse.ArgumentTypeError: it cannot be written, which is better known before measuring.
    """
    folder = Path(name).absolute().parent
    if name and (not os.access(folder, os.W_OK) or Path(name).is_dir()):
        raise argparse.ArgumentTypeError(
            f"{name} cannot be written: is {folder} a folder of yours?"
        )
    return name


def count(text: str) -> int:
    """Reads a whole number of at least 1; the `type` of an argument of argparse."""
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"{text} is no count: give a whole number of at least 1.")
    return int(text)
