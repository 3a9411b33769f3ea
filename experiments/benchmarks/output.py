"""The `type` of an argument that names a file to write."""

import argparse
import os
from pathlib import Path


def output_file(name: str) -> str:
    """Checks the name of a file to write, "" for none; the `type` of an argument of argparse.

    Raises:
      argparse.ArgumentTypeError: it cannot be written, which is better known before measuring.
    """
    folder = Path(name).absolute().parent
    if name and not os.access(folder, os.W_OK):
        raise argparse.ArgumentTypeError(
            f"{name} cannot be written: is {folder} a folder of yours?"
        )
    return name
