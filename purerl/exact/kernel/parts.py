"""A long kernel cut into functions, which NVRTC compiles in a quarter of the time."""

import re
from collections.abc import Iterable

# Characters of a function: with 20,000 a humanoid's kernel takes a quarter of the time. What has
# fewer than FEW between two branches stays there.
MOST, FEW = 20_000, 2_000
OWN_NAMES = re.compile(r"\b(which|in\d+|out\d+)\b")  # of the kernel, which no part of it knows


def in_parts(lines: Iterable[str]) -> tuple[list[str], list[str]]:
    """Returns functions of what stands between loops and branches, and lines that call them."""
    routines: list[str] = []
    kept: list[str] = []
    some: list[str] = []
    for line in lines:
        apart = line.count("{") == line.count("}") and not OWN_NAMES.search(line)
        if not apart or sum(map(len, some)) > MOST:
            if sum(map(len, some)) > FEW:
                name = f"part{len(routines)}"
                routines.append("\n".join([f"PART({name})", *some, "}"]))
                some = [f"{name}(P, thread);"]
            kept, some = kept + some, []
        (some if apart else kept).append(line)
    return routines, kept + some
