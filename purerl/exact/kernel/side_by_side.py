"""Statements that do not read each other's results, side by side.

A lane waits for hundreds of cycles for an entry of a table, and for tens for a number of memory.
Here it reads all that several numbers need before it writes one of them, and so waits once.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from purerl.exact.kernel.lanes import LANES

AT_ONCE = 40  # numbers that a lane reads before it writes: each takes a register or two
MOST_PARTS = 4  # of a statement that is written out, without a loop


class Job(NamedTuple):
    """Numbers that are computed alike."""

    size: int
    reads: int  # numbers that are read for each of them
    lines: Callable[[str, str], tuple[list[str], str]]  # (place, prefix of names) -> (C, result)
    target: Callable[[str], str]  # place -> C for where its number goes


class Part(NamedTuple):
    """The numbers of a job that the lanes of a warp compute at once."""

    job: Job
    first: int

    @property
    def place(self) -> str:
        """C for the place of a lane's number; lanes beyond the last compute the last, too."""
        if self.job.size == 1:
            return "0"
        one = f"lane+{self.first}" if self.first else "lane"
        return one if self.job.size >= self.first + LANES else f"least({one}, {self.job.size - 1})"


def parts_of(job: Job) -> list[Part]:
    """Returns the parts of a job, or none if it needs a loop."""
    number = -(-job.size // LANES)
    return [Part(job, LANES * k) for k in range(number)] if number <= MOST_PARTS else []


def groups(parts: Sequence[Part]) -> Iterator[list[Part]]:
    """Yields parts that one warp computes, by how much they read."""
    group: list[Part] = []
    for part in parts:
        if group and sum(x.job.reads for x in group) + part.job.reads > AT_ONCE:
            yield group
            group = []
        group.append(part)
    if group:
        yield group


def written(pairs: Sequence[tuple[Job, str]]) -> str:
    """Returns C that computes a number of each job at a place, and then puts all of them away."""
    body: list[str] = []
    ends: list[str] = []
    for number, (job, place) in enumerate(pairs):
        name, at = f"n{number}", place
        if not place.isalnum():
            at = f"{name}i"
            body.append(f"const int {at} = {place};")
        lines, result = job.lines(at, name)
        body += lines
        ends.append(f"{job.target(at)} = {result};")
    return " ".join(body + ends)


def group_text(group: Sequence[Part]) -> str:
    """Returns C for what one warp does with a group."""
    lanes = max(min(LANES, part.job.size - part.first) for part in group)
    return f"WARP({lanes}) {{ {written([(part.job, part.place) for part in group])} }}"


def loop_text(job: Job, turn: int) -> str:
    """Returns C for a loop over a job, which reads for several numbers at once."""
    times = max(1, min(MOST_PARTS, AT_ONCE // (2 * job.reads)))
    pairs = [(job, f"AT(i, {k}, {job.size})" if k else "i") for k in range(times)]
    return f"SEVERAL({turn}, i, {times}, {job.size}) {{ {written(pairs)} }}"
