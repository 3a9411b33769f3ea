"""Which experiments' code is known to this user on this machine, and may be executed from a run.

A run's folder holds a copy of its experiment, and may come from a stranger. The copy is executed if
the same bytes stand in `experiments/`, beside a policy that comes with the library, or in the list
that this module keeps: of every experiment that this user has trained, and of every one that they
vouched for by `--trust`. What the folder says of itself counts for nothing: a stranger writes its
manifest too.
"""

import contextlib
import hashlib
import json
import os
from pathlib import Path

from purerl.core.errors import UserError
from purerl.experiment import loading
from purerl.machine.files import check_inside, read_bytes


def load_copy(copy: Path, text: bytes, name: str, original: Path, trust: bool) -> loading.Source:
    """Executes a run's copy of its experiment.

    Args:
      copy: the file, in the run's folder.
      text: what it holds.
      name: the experiment's.
      original: the file that the copy was made of, as the run says.
      trust: whether the user vouches for the copy, which is then known from now on.

    Raises:
      UserError: the code is not known, or has a mistake.
    """
    check_inside(copy.parent, copy)
    places = known_places(text, name)
    if not places and not trust:
        raise UserError(
            f"{copy.parent} holds code of its own, {copy.name}, that is not known on this machine: "
            "read it, then add --trust (in Python: trust=True)."
        )
    # A project may have been moved or renamed since: who vouches again says that it is here now.
    if not any(place.is_file() for place in places) and (trust or not places):
        here = Path(f"{name}.py").absolute()  # the user's own folder, which moved with its runs
        found = here if here.is_file() and here.read_bytes() == text else copy.resolve()
        places = [original if original.is_file() else found]
        remember(text, places[0])
    # What the code reads beside `__file__` is as trusted as the code, so the folder has no say.
    there = [place for place in places if place.is_file()] or places
    return loading.load_file(copy, name, text, original if original in there else there[-1])


def known_places(text: bytes, name: str) -> list[Path]:
    """Returns the files whose code is known to be `text`; of named experiments, that of `name`."""
    ours = [*loading.POLICIES.glob("*/experiment.py"), loading.available().get(name)]
    found = [file for file in ours if file is not None and file.read_bytes() == text]
    wanted = hashlib.sha256(text).hexdigest()
    for line in _lines():
        with contextlib.suppress(ValueError, TypeError):
            known, place = line.split(None, 1)
            found += [Path(json.loads(place))] if known == wanted else []
    return found


def remember(text: bytes, place: Path) -> None:
    """Adds an experiment to the list; a home that cannot be written to is no mistake of a run."""
    line = f"{hashlib.sha256(text).hexdigest()}  {json.dumps(str(place))}"
    if line in _lines():
        return
    with contextlib.suppress(OSError, RuntimeError):
        _list().parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with _list().open("a") as file:
            file.write(line + "\n")


def _lines() -> list[str]:
    try:
        return read_bytes(_list()).decode().splitlines()
    except (UserError, ValueError, RuntimeError):  # there is none yet, or no home
        return []


def _list() -> Path:
    """Returns the list's file, where the user keeps state (XDG_STATE_HOME)."""
    states = Path(os.environ.get("XDG_STATE_HOME", ""))
    if not states.is_absolute():  # the freedesktop.org specification takes no other
        states = Path.home() / ".local" / "state"
    return states / "purerl" / "trusted"
