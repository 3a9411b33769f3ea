"""What MuJoCo said of simulations that were lost, or lacked contacts, in this process."""

import collections

said: collections.Counter[str] = collections.Counter()


def note(text: str) -> None:
    """Counts MuJoCo's words for one simulation, in one line."""
    said[" ".join(text.split())] += 1


def most() -> str:
    """Returns what MuJoCo has said most often since `said` was cleared, or ""."""
    return "".join(f"MuJoCo, {n} times: {text}" for text, n in said.most_common(1))
