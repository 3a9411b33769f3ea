"""How a command ends: its exit code, and its error as one line."""

import os
import signal
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from purerl.core.errors import RunError, StoppedError, UserError


def tell(error: UserError | RunError | StoppedError) -> int:
    """Prints an error as one line and returns its exit code."""
    print(f"purerl: {error}", file=sys.stderr)
    return error.exit_code


def leave(command: Callable[[], int]) -> NoReturn:
    """Runs a command and ends the process with its exit code.

    An error is told in one line. Two ends are silent, with the exit code of a program that the
    signal ended: Ctrl-C before a run has begun (SIGINT), a reader that left (`| head`, SIGPIPE).
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


def own_line(error: BaseException | None) -> str:
    """Returns " (FILE, line N)": the last line of the user's own code on the way to an error.

    Code of this library and of installed packages is not the user's. "" if no line is.
    """
    frames = traceback.extract_tb(error.__traceback__ if error else None)
    others = ("site-packages", "dist-packages", str(Path(__file__).parent.parent))
    own = [frame for frame in frames if not any(other in frame.filename for other in others)]
    return f" ({own[-1].filename}, line {own[-1].lineno})" if own else ""
