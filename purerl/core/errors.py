"""Errors that a person can act on: one line, no traceback, and an exit code."""

import argparse
import difflib
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NoReturn

SUCCESS = 0
FAILURE = 1  # the run could not go on: non-finite numbers, a disk that refuses the last checkpoint
USAGE = 2  # the command asks for something that cannot be done
INTERRUPTED = 3  # stopped by SIGTERM or SIGINT after saving; the same command with --resume goes on


class UserError(Exception):
    """A mistake in the command, a file or the machine's set-up; the message says how to mend it."""

    exit_code = USAGE


class RunError(Exception):
    """A run that cannot go on."""

    exit_code = FAILURE


class StoppedError(Exception):
    """A run that was asked to stop, and stopped in good order."""

    exit_code = INTERRUPTED


def unknown(kind: str, name: str, valid: Iterable[str], where: str = "") -> UserError:
    """Returns the error for a name that is none of `valid`: the nearest ones first, then all."""
    valid = sorted(valid)
    near = difflib.get_close_matches(name, valid, n=1, cutoff=0.5)
    hint = f" Did you mean {near[0]}?" if near else ""
    listed = ", ".join(valid) if valid else "none"
    return UserError(f"There is no {kind} {name!r}{where}.{hint} Valid: {listed}.")


def output_file(name: str) -> str:
    """Returns the name of a file to write, "" for none; the `type` of an argument of argparse.

    Raises:
      argparse.ArgumentTypeError: it cannot be written, which is better known before measuring.
    """
    folder = Path(name).absolute().parent
    if name and not os.access(folder, os.W_OK):
        raise argparse.ArgumentTypeError(
            f"{name} cannot be written: is {folder} a folder of yours?"
        )
    return name


def one_line(error: BaseException) -> str:
    """Returns an exception as one line of text, with its class where the message alone is bare."""
    text = " ".join(str(error).split())
    return text if len(text) > 20 else f"{type(error).__name__}: {text}"


def own_line(error: BaseException | None) -> str:
    """Returns " (FILE, line N)", the last line of somebody's own code on the way to an error.

    That is neither this library's nor an installed package's; "" if there is none.
    """
    frames = traceback.extract_tb(error.__traceback__ if error else None)
    others = ("site-packages", "dist-packages", str(Path(__file__).parent.parent))
    own = [frame for frame in frames if not any(other in frame.filename for other in others)]
    return f" ({own[-1].filename}, line {own[-1].lineno})" if own else ""


def tell(error: UserError | RunError | StoppedError) -> int:
    """Prints an error as one line and returns its exit code."""
    print(f"purerl: {error}", file=sys.stderr)
    return error.exit_code


def leave(command: Callable[[], int]) -> NoReturn:
    """Ends the process with a command's exit code, or with that of its error, told in one line.

    In silence when its reader has left (`| head`).
    The code is then the one of a program that SIGPIPE ended; in silence too, with that of SIGINT,
    after Ctrl-C where nothing has begun.
    """
    try:
        code = command()
        sys.stdout.flush()
    except (UserError, RunError) as error:
        code = tell(error)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes once more
        code = 128 + signal.SIGPIPE
    except KeyboardInterrupt:
        code = 128 + signal.SIGINT
    sys.exit(code)
