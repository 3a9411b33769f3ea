"""Functions that a user wrote: how they are called, and what goes wrong in them, in one line."""

import contextlib
import inspect
import re
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jax._src import callback, dispatch  # JAX has no public way to forget one that failed

from purerl.core.errors import RunError, UserError, one_line

# Code of this library and of installed packages is not the user's.
_OTHERS = ("site-packages", "dist-packages", "<", str(Path(__file__).parent.parent))
_LATER = "a value that is known only when the compiled program runs"
_SIZES = f"float(), int(), an index or a shape asks for {_LATER}; keep it an array "
_SIZES += "(x.astype(jnp.float32)), and sizes constant"
_TRACED = {
    "TracerBoolConversionError": f"a Python `if`, `while`, `and`, `or` or `not` asks for {_LATER}; "
    "use jnp.where, jnp.logical_and or jax.lax.cond",
    "TracerArrayConversionError": f"numpy was given {_LATER}; use jax.numpy (jnp) in place of "
    "numpy (np)",
    "ConcretizationTypeError": _SIZES,
    "TracerIntegerConversionError": _SIZES,
}
_MENDS = {  # by what the error says
    "invalid PRNG key": "the key comes first, as in jax.random.split(key, 3)",
    "'Readings' object has no": "name it where the Physics is made: Physics(model, (NAME, ...))",
    "cannot assign to field": "an environment stays as it was built: put it into State.task",
    "Error opening file": "write Path(__file__).parent / NAME, or start where the file is",
}


def in_words(error: BaseException) -> str:
    """Returns an error of a user's function as one line; of JAX's tracing in a person's words."""
    said = _TRACED.get(type(error).__name__) or one_line(error)
    mends = (mend for part, mend in _MENDS.items() if part in said and mend not in said)
    return "; ".join([said, *mends])


def own_line(error: BaseException | None) -> str:
    """Returns " (FILE, line N)": the last line of the user's own code on the way to an error.

    "" if no line is.
    """
    frames = traceback.extract_tb(error.__traceback__ if error else None)
    return _last_own([(frame.filename, frame.lineno) for frame in frames])


def _last_own(frames: list[tuple[str, Any]]) -> str:
    own = [place for place in frames if not any(other in place[0] for other in _OTHERS)]
    return f" ({own[-1][0]}, line {own[-1][1]})" if own else ""


@contextlib.contextmanager
def users_errors(what: str) -> Iterator[None]:
    """Makes one line, a UserError, of an error in what the user wrote, called `what`.

    An error on whose way no line is the user's goes on as it is: it is a fault of this library, but
    for a ValueError or an ImportError, which tell a rule.
    """
    try:
        yield
    except (UserError, RunError):
        raise
    except Exception as error:
        where = own_line(error)
        if not where and not isinstance(error, ValueError | ImportError):
            raise
        raise UserError(f"{what}{in_words(error)}{where}") from error


def check_takes(name: str, function: Any, *arguments: str, cure: str = "") -> None:
    """Raises UserError, with the `cure`, unless a function can be called with as many arguments."""
    call = f"{name}({', '.join(arguments)})"
    if not callable(function):
        raise UserError(f"{name} is a {type(function).__name__}, and must be a function: {call}.")
    try:
        taken = inspect.signature(function)
    except (TypeError, ValueError):  # of C code, which has none
        return
    try:
        taken.bind(*arguments)
    except TypeError as error:
        raise UserError(f"{name} takes {taken}, and is called as {call}.{cure}") from error


@contextlib.contextmanager
def program_errors() -> Iterator[None]:
    """Makes one line of an error in a compiled program: no memory, or a callback that raised.

    Raises:
      RunError: the program failed for one of the two.
    """
    callback.logger.disabled = True  # it would print a traceback besides
    try:
        yield
    except (RunError, UserError):  # told already: of a full disk, by the words of a full memory
        raise
    except Exception as error:
        said = str(error)
        if "RESOURCE_EXHAUSTED" in said or "ut of memory" in said:
            raise RunError(
                "The memory of the device is full: lower ppo.num_envs, ppo.rollout_length or the "
                "network's widths."
            ) from error
        # XLA hands a callback's error on as text, traceback and all: from ours to the user's.
        lines = re.findall(r"^[\w.]+(?:Error|Exception)\b.*", said, re.MULTILINE)
        frames = re.findall(r'"(.+?)", line (\d+)', said)
        ours = [i for i, frame in enumerate(frames) if _OTHERS[-1] in frame[0]]
        where = _last_own(frames[max(ours, default=0) :]) if lines else own_line(error)
        if not (lines or where):
            raise
        dispatch.runtime_tokens.clear()  # or JAX tells it again, with tracebacks, at the end
        what = lines[-1] if lines else one_line(error)
        raise RunError(f"A function called from a compiled program raised {what}{where}") from error
