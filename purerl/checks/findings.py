"""What checks found: a line each."""

import functools
from typing import NamedTuple


class Finding(NamedTuple):
    """One line of a check."""

    level: str  # "ok", "warning" or "error"
    about: str  # what was checked, in a word or two
    text: str

    def __str__(self) -> str:
        """Returns the line."""
        return f"{self.level:8} {self.about:12} {self.text}"


ok = functools.partial(Finding, "ok")  # nothing to mend
warning = functools.partial(Finding, "warning")  # it trains, but probably not as it is meant to
error = functools.partial(Finding, "error")  # it breaks a rule, or cannot learn
