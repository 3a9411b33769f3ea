"""What the page says of a session: plots, tables and lines; pure."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from purerl.report.html_elements import Html, element, join, table
from purerl.tune.plan.episodes import TERM
from purerl.tune.view.session import Row, Session

MOST_POINTS = 200  # of a plot's line
RECENT = 1.0  # what "per second" is taken over [s]


class Plot(NamedTuple):
    """Lines over time."""

    names: tuple[str, ...]
    columns: tuple[np.ndarray, ...]  # time [s], then a line for each name; [K] each


def terms_of(session: Session) -> tuple[str, ...]:
    """Returns the metrics that are terms of the reward."""
    names = session.rows[-1].metrics if session.rows else session.sums
    return tuple(name for name in names if name.startswith(TERM))


def plots(session: Session) -> dict[str, Plot]:
    """Returns the reward and its terms, the value that the driver expects, and the actions."""
    terms, size = terms_of(session), session.program.env.action_size
    rewards = ("reward", *(term.removeprefix(TERM) for term in terms))
    rows = session.rows[:: -(-len(session.rows) // MOST_POINTS) or 1]

    def plot(names: tuple[str, ...], numbers: Callable[[Row], list[Any]]) -> Plot:
        values = np.array([[row.time, *numbers(row)] for row in rows]).reshape(-1, 1 + len(names))
        return Plot(names, tuple(np.ascontiguousarray(values.T)))

    return {
        "Reward per step": plot(rewards, lambda x: [x.reward, *(x.metrics[t] for t in terms)]),
        "Value": plot(("value",), lambda x: [x.value]),
        "Actions": plot(tuple(f"a{i}" for i in range(size)), lambda x: [*x.action]),
    }


def reward_table(session: Session) -> Html:
    """Returns which term pays for what is shown, and the other metrics."""
    if not session.rows:
        return join([])
    last, sums, terms = session.rows[-1], session.sums, terms_of(session)
    recent = [row for row in session.rows if row.time > last.time - RECENT - 1e-9]
    mean = {name: float(np.mean([row.metrics[name] for row in recent])) for name in last.metrics}
    paid, whole = [float(np.mean([row.reward for row in recent]))], sum(abs(mean[t]) for t in terms)
    share = {term: f"{mean[term] / whole:+.0%}" if whole > 0 else "" for term in terms}
    rows = [[element("b", "reward"), last.reward, *paid, sums["reward"], ""]]
    rows += [[t.removeprefix(TERM), last.metrics[t], mean[t], sums[t], share[t]] for t in terms]
    others = [name for name in sums if name not in terms and name != "reward"]
    rows += [[element("i", name), last.metrics[name], mean[name], "", ""] for name in others]
    shown = [[x if isinstance(x, str) else f"{x:.3f}" for x in row] for row in rows]
    heads = ["", "step", "1 s mean", "episode", "share"]
    return element("div", table(heads, shown), style="text-align:right")


def said(session: Session, pace: str) -> Html:
    """Returns what is going on, what went wrong, and the reward; `pace` says how fast it goes."""
    timestep = session.program.env.control_timestep
    doing = pace if session.playing else "paused"
    lines = [
        f"{session.checkpoint}, seed {session.seed}, episode {session.episode}",
        f"{session.length * timestep:.2f} s, step {session.length}, "
        f"return {session.sums.get('reward', 0.0):.4g}",
        doing,
        session.ended,
        session.trouble and element("b", session.trouble),
    ]
    told = (element("div", line) for line in lines if line)
    return element("div", *told, reward_table(session), style="font-size:0.8em;padding:0 1em")


def as_typed(words: str) -> Html:
    """Returns the words of a command line as they are typed."""
    return element("pre", words, style="font-size:0.8em;padding:0 1em;white-space:pre-wrap")
