"""How a command ends: its exit code, and its error as one line."""

import importlib.util
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import NoReturn

import purerl
from purerl.core.errors import RunError, StoppedError, UserError, one_line
from purerl.machine import output

LAST_SECONDS = 15.0  # from the end of the main thread to that of the process


def tell(error: UserError | RunError | StoppedError) -> int:
    """Prints an error as one line and returns its exit code."""
    output.warn(f"purerl: {error}")
    return error.exit_code


def check_installed(package: str, extra: str) -> None:
    """Raises UserError, with the line to paste, unless a package of an extra is there."""
    if importlib.util.find_spec(package) is None:
        line = purerl.how_to_install(extra)
        raise UserError(f"The package {package} is not installed; run: {line}")


def leave(command: Callable[[], int]) -> NoReturn:
    """Runs a command and ends the process with its exit code.

    An error is told in one line. Two ends are silent, with the exit code of a program that the
    signal ended: Ctrl-C before a run has begun (SIGINT), a reader that left (`| head`, SIGPIPE).
    """
    output.hold_standard_files()
    try:
        try:
            code = command()
        finally:
            output.show()  # what waits, of a help page too
    except (UserError, RunError) as error:
        code = tell(error)
    except (RuntimeError, AssertionError) as error:
        if not (named := os.environ.get("JAX_PLATFORMS")) or _jax_runs():
            raise
        why = f" ({one_line(error)})" if str(error) else ""
        code = tell(UserError(
            f"JAX_PLATFORMS is {named}, and this JAX cannot start that{why}: unset it, or install "
            "JAX for that device (docs/howto/devices.md)."
        ))  # fmt: skip
    except BrokenPipeError:
        code = 128 + signal.SIGPIPE
    except KeyboardInterrupt:
        code = 128 + signal.SIGINT
    output.flush_or_drop(sys.stderr)
    end_in_time(code)
    sys.exit(code)


def _jax_runs() -> bool:
    """Tells whether JAX has found a device: with none, nothing has begun that could be wrong."""
    try:
        return bool(sys.modules["jax"].devices()) if "jax" in sys.modules else True
    except (RuntimeError, AssertionError):
        return False


def end_in_time(code: int) -> None:
    """Ends the process some time after its main thread, whatever threads of libraries still wait.

    All that a command promises is done by then. On a disk without inodes, threads of Orbax waited
    for ever.
    """

    def watch() -> None:
        threading.main_thread().join()
        time.sleep(LAST_SECONDS)
        os._exit(code)

    threading.Thread(target=watch, daemon=True).start()
