"""Whether a run that was disturbed has come through: the one place that says what is demanded."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

from purerl.core.errors import FAILURE, INTERRUPTED, SUCCESS, USAGE
from tests.faults.commands import Answer, Worker
from tests.long.kills import find, read_lines

NAME = "run"
TOY = Path(__file__).parent.parent / "runs" / "toy_experiment.py"
# Six updates: checkpoints after 2, 4, 6; evaluations after 3 and 6; a deletion of a checkpoint.
SHORT = [str(TOY), "--ppo.num-steps", "199", "--checkpoints", "3", "--keep", "1"]
STOP_AT = "evaluation: return"  # the first one, after which no checkpoint is planned


class Whole(NamedTuple):
    """A run that nobody disturbed."""

    words: list[str]  # of its command
    lines: list[list[dict[str, Any]]]  # of each seed's metrics.jsonl, without the clock


def go_on(words: list[str], place: Path) -> list[str]:
    """Returns the words of the run in `place`/runs; --resume, if there is something to resume."""
    return [*words, *(["--resume"] if find(place / "runs", NAME) else [])]


def command(words: list[str], place: Path) -> list[str]:
    """Returns the same words, and where the run is."""
    return [*go_on(words, place), "--runs", str(place / "runs"), "--name", NAME]


def undisturbed(
    worker: Worker,
    words: list[str],
    place: Path,
    record: Path | None = None,
    trace: Path | None = None,
) -> Whole:
    """Makes the run without disturbing it; RuntimeError if even that fails."""
    answer = worker.run(command(words, place), place, record, trace)
    if answer.code != SUCCESS:
        raise RuntimeError(f"The undisturbed run ended with {answer.code}:\n{answer.said}")
    return Whole(words, read_lines(place / "runs", NAME))


def complaint(answer: Answer, place: Path, whole: Whole) -> str:
    """Returns what is wrong with a run that was taken to its end, in words; "" if nothing is."""
    if ill := _ill(answer):
        return ill
    if answer.code != SUCCESS:
        return f"exit code {answer.code}: {_last_line(answer.err)}"
    if aside := set_aside(place):
        return f"a checkpoint was set aside: {aside[0]}"
    return _difference(place, whole)


def untold(answer: Answer) -> str:
    """Returns what is wrong with how a command told its error, in words; "" if nothing is."""
    if ill := _ill(answer):
        return ill
    if answer.code not in (FAILURE, USAGE, INTERRUPTED):
        return f"exit code {answer.code}"
    told = [line for line in answer.err.splitlines() if line.startswith("purerl: ")]
    if len(told) != 1:
        return f"{len(told)} lines of error: {answer.err.strip()}"
    return ""


def set_aside(place: Path) -> list[str]:
    """Returns the names of the checkpoints that a run has put aside as damaged."""
    return sorted(path.name for path in place.glob("runs/*/*/checkpoints/damaged-*"))


def saved(place: Path) -> int:
    """Returns the newest update that the run has a checkpoint of, 0 if there is none."""
    found = place.glob("runs/*/*/checkpoints/[0-9]*")
    return max((int(path.name) for path in found if path.name.isdigit()), default=0)


def began_at(answer: Answer, whole: Whole) -> int:
    """Returns the update after which a command went on, 0 if it began anew."""
    if "Already done" in answer.out:
        return last(whole)
    found = re.search(r"Resuming after update (\d+)", answer.out)
    return int(found[1]) if found else 0


def kind_of(text: str) -> str:
    """Returns a complaint without what differs from case to case, to count kinds of them."""
    text = re.sub(r"/[^\s:;,'\"]*/", "", text)
    text = re.sub(r"\b[0-9a-f]{12,}\b|\b\d+\b", "#", text)
    return text.split("\n")[0][:150]


def last(whole: Whole) -> int:
    """Returns the run's last update."""
    return whole.lines[0][-1]["update"]


def _ill(answer: Answer) -> str:
    """Returns what no command may do, in words; "" if it did not."""
    if answer.hung:
        return "it hangs"
    if "Traceback" in answer.said or answer.code is None:
        return f"a traceback: {_last_line(answer.err)}"
    return "it would hang at its end" if answer.stuck else ""


def _difference(place: Path, whole: Whole) -> str:
    """Returns where metrics.jsonl, the digests in it included, is not the undisturbed run's."""
    try:
        lines = read_lines(place / "runs", NAME)
    except ValueError as error:
        return f"metrics.jsonl cannot be read: {error}"
    if len(lines) != len(whole.lines):
        return f"{len(lines)} of {len(whole.lines)} runs"
    for seed, (mine, theirs) in enumerate(zip(lines, whole.lines, strict=True)):
        numbers = [line["update"] for line in mine]
        if numbers != [line["update"] for line in theirs]:
            return f"metrics.jsonl of seed {seed} has the updates {numbers}"
        for one, other in zip(mine, theirs, strict=True):
            if one != other:
                names = [name for name in {**one, **other} if one.get(name) != other.get(name)]
                return f"update {one['update']} of seed {seed} has another {names[0]}"
    return ""


def _last_line(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("Go on")]
    return lines[-1] if lines else "(nothing was said)"
