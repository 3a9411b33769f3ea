"""What checks found: a line each."""

from typing import NamedTuple


class Finding(NamedTuple):
    """One line of a check."""

    level: str  # "ok", "warning" or "error"
    about: str  # what was checked, in a word or two
    text: str

    def __str__(self) -> str:
        """Returns the line."""
        return f"{self.level:8} {self.about:12} {self.text}"


def ok(about: str, text: str) -> Finding:
    """Nothing to mend."""
    return Finding("ok", about, text)


def warning(about: str, text: str) -> Finding:
    """It trains, but probably not as it is meant to."""
    return Finding("warning", about, text)


def error(about: str, text: str) -> Finding:
    """It breaks a rule, or cannot learn."""
    return Finding("error", about, text)


def some(names: list[str], most: int = 6) -> str:
    """Returns names in a line, the first few of many."""
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")
