"""What is printed: harmless to a terminal, and no reason for training to end. No JAX.

What stands in files and names may command a terminal, so it is printed escaped. Standard output may
be full, closed or left by its reader: a command that only answers then ends, training goes on.
"""

import contextlib
import functools
import os
import sys
from collections.abc import Callable, Iterator
from typing import Any

from purerl.core.errors import RunError, reason

Say = Callable[[str], None]  # prints a line
REFUSALS = (OSError, ValueError)  # the latter of a stream that Python has closed


def printable(text: str, encoding: str | None = None) -> str:
    r"""Returns one line of text in which whatever is not printable is escaped.

    >>> printable("a\x1b[2Jb\u202e")
    'a\\x1b[2Jb\\u202e'
    """
    parts = (c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    encoding = encoding or "utf-8"
    return "".join(parts).encode(encoding, "backslashreplace").decode(encoding)


@contextlib.contextmanager
def answering() -> Iterator[None]:
    """Prints the answer of a command.

    Raises:
      RunError: standard output does not take it.
      BrokenPipeError: its reader has left.
    """
    try:
        yield
        if sys.stdout is not None:  # it was closed when the process began
            sys.stdout.flush()
    except OSError as error:
        discard(sys.stdout)
        if isinstance(error, BrokenPipeError):
            raise
        raise RunError(f"Standard output cannot be written: {reason(error)}.") from error


def show(*lines: str) -> None:
    """Prints the lines of an answer; see `answering`."""
    with answering():
        for line in lines:
            print(printable(line, getattr(sys.stdout, "encoding", None)))


def say(line: str) -> None:
    """Prints a line of training, which goes on if nothing can be printed."""
    if sys.stdout is not None:
        file: Any = Guarded(sys.stdout)
        print(printable(line, sys.stdout.encoding), file=file, flush=True)


def warn(text: str) -> None:
    """Prints lines to standard error, if it takes them."""
    if sys.stderr is not None:
        lines = [printable(line, sys.stderr.encoding) for line in text.split("\n")]
        # RuntimeError: a signal's handler comes while another line is printed.
        with contextlib.suppress(*REFUSALS, RuntimeError):
            print("\n".join(lines), file=sys.stderr, flush=True)


class Guarded:
    """A stream that loses what it cannot write, and says so once."""

    def __init__(self, stream: Any) -> None:
        """Guards `stream`."""
        self.stream = stream

    def write(self, text: str) -> int:
        """Writes if it can."""
        self._attempt(self.stream.write, text)
        return len(text)

    def flush(self) -> None:
        """Writes what waits, if it can: what a full disk refuses waits for the next time."""
        self._attempt(self.stream.flush)

    def isatty(self) -> bool:
        """Tells whether it is a terminal; a closed stream is none."""
        closed = self.stream is None or getattr(self.stream, "closed", False)
        return not closed and self.stream.isatty()

    def __getattr__(self, name: str) -> Any:
        """Answers as the stream does, such as whether it is a terminal."""
        return getattr(self.stream, name)

    def _attempt(self, function: Callable[..., Any], *arguments: Any) -> None:
        try:
            function(*arguments)
        except REFUSALS as error:
            _tell_of_loss(reason(error))
            if isinstance(error, BrokenPipeError):  # no reader will come back
                discard(self.stream)


@functools.cache
def _tell_of_loss(why: str) -> None:
    warn(f"purerl: Standard output cannot be written: {why}. Training goes on without it.")


def flush_or_drop(stream: Any) -> None:
    """Drops what a stream does not take, or Python would fail at its end."""
    if stream is not None:
        try:
            stream.flush()
        except REFUSALS:
            discard(stream)


def discard(stream: Any) -> None:
    """Leads a stream to nowhere from now on, with what waits in it."""
    with contextlib.suppress(*REFUSALS):  # one without a file, as in a notebook
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def hold_standard_files() -> None:
    """Opens standard input, output and error where they are closed.

    Else the next file that is opened has the number of one of them, and messages of C++ code get
    into it.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
