"""How a command ends: its exit code, and its error as one line."""

import os
import signal
import sys
from collections.abc import Callable
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
