"""Errors that a person can act on: one line that says what is wrong and how to mend it."""

import difflib
import re
from collections.abc import Iterable
from typing import Any

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


def nearest(name: str, valid: Iterable[str]) -> str:
    """Returns the valid name that a wrong one is surely meant to be, or "".

    Args:
      name: the wrong name.
      valid: the names there are.

    >>> nearest("ppo.learing_rate", ["ppo.clip", "ppo.learning_rate"])
    'ppo.learning_rate'
    >>> nearest("ppo.lr", ["ppo.clip", "ppo.learning_rate"])  # its initials
    'ppo.learning_rate'
    >>> nearest("reward_near", ["train/reward"])
    ''
    >>> nearest("Turn_3", ["Turn_3.p", "Turn_4.p"])  # the beginning of one alone
    'Turn_3.p'
    """
    last = {v: re.split(r"[./]", v)[-1] for v in valid}
    tail = re.split(r"[./]", name)[-1]
    for whole, part in last.items():
        if len(tail) > 1 and tail == "".join(word[:1] for word in re.split("[-_]", part)):
            return whole
    begun = [whole for whole in last if whole.startswith(f"{name}.")]
    if len(begun) == 1:
        return begun[0]
    near = difflib.get_close_matches(name, last, n=1, cutoff=0.65)
    # What only the beginning has in common, such as "ppo.", is no likeness.
    alike = near and difflib.SequenceMatcher(None, tail, last[near[0]]).ratio() >= 0.6
    return near[0] if alike else ""


def unknown_name(kind: str, name: str, valid: Iterable[str], where: str = "") -> str:
    """Returns the message for a name that does not exist: the nearest one, then all there are.

    Args:
      kind: what the name should name, such as "joint".
      name: the wrong name.
      valid: the names there are; empty ones are left out.
      where: where it was looked for, such as " in these runs".
    """
    valid = [v for v in valid if v]
    near = nearest(str(name), valid)
    hint = f" Did you mean {near!r}?" if near else ""
    return f"There is no {kind} {name!r}{where}.{hint} There are: {', '.join(valid) or 'none'}."


def some(names: Iterable[str], most: int = 6) -> str:
    """Returns names in a line, those after the first `most` as their number."""
    every = list(names)
    rest = len(every) - most
    return ", ".join(every[:most]) + (f" and {rest} more" if rest > 0 else "")


def check_least(owner: Any, refusal: type[Exception], **least: float) -> None:
    """Raises a `refusal` that names the first of an object's numbers that is below its least."""
    for name, number in least.items():
        if not getattr(owner, name) >= number:
            raise refusal(f"{name} is {getattr(owner, name)}; it must be at least {number}.")


def one_line(error: BaseException) -> str:
    """Returns an exception as one line of text, with its class where the message alone is bare."""
    text = " ".join(str(error).split())
    return text if len(text) > 20 else f"{type(error).__name__}: {text}"


def reason(error: BaseException) -> str:
    """Returns why a file could not be read or written, in a few words."""
    return getattr(error, "strerror", None) or one_line(error)
