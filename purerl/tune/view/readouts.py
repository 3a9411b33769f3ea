"""What the page says of a session: plots, tables and lines; pure."""

import html
from typing import NamedTuple

import numpy as np

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


def reward_plot(session: Session) -> Plot:
    """Returns the reward and its terms, per control step."""
    terms = terms_of(session)
    names = ("reward", *(term.removeprefix(TERM) for term in terms))
    return _plot(session, names, lambda row: [row.reward, *(row.metrics[t] for t in terms)])


def value_plot(session: Session) -> Plot:
    """Returns the value that the driver expects."""
    return _plot(session, ("value",), lambda row: [row.value])


def action_plot(session: Session) -> Plot:
    """Returns the actions."""
    size = session.program.env.action_size
    return _plot(session, tuple(f"a{i}" for i in range(size)), lambda row: list(row.action))


def _plot(session: Session, names: tuple[str, ...], numbers) -> Plot:
    rows = session.rows[:: -(-len(session.rows) // MOST_POINTS) or 1]
    values = np.array([[row.time, *numbers(row)] for row in rows]).reshape(-1, 1 + len(names))
    return Plot(names, tuple(np.ascontiguousarray(values.T)))


def reward_table(session: Session) -> str:
    """Returns, as HTML, which term pays for what is shown, and the other metrics."""
    if not session.rows:
        return ""
    recent = [row for row in session.rows if row.time > session.rows[-1].time - RECENT - 1e-9]
    terms = terms_of(session)
    others = [name for name in session.sums if name not in terms and name != "reward"]
    last, whole = session.rows[-1], sum(abs(_mean(recent, term)) for term in terms)
    lines = [_line("<b>reward</b>", last.reward, _mean(recent, ""), session.sums["reward"], "")]
    for term in terms:
        mean = _mean(recent, term)
        share = f"{mean / whole:+.0%}" if whole > 0 else ""
        name = html.escape(term.removeprefix(TERM))
        lines.append(_line(name, last.metrics[term], mean, session.sums[term], share))
    for name in others:
        mean = _mean(recent, name)
        lines.append(_line(f"<i>{html.escape(name)}</i>", last.metrics[name], mean, None, ""))
    head = "".join(f"<th>{word}</th>" for word in ("", "step", "1 s mean", "episode", "share"))
    style = 'style="font-size:0.8em;width:100%;text-align:right;padding:0 1em"'
    return f"<table {style}><tr>{head}</tr>{''.join(lines)}</table>"


def _mean(rows: list[Row], name: str) -> float:
    return float(np.mean([row.metrics[name] if name else row.reward for row in rows]))


def _line(name: str, now: float, mean: float, total: float | None, share: str) -> str:
    cells = [f"{now:.3f}", f"{mean:.3f}", "" if total is None else f"{total:.2f}", share]
    return f"<tr><td>{name}</td>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"


def status_lines(session: Session, pace: str) -> list[str]:
    """Returns what is going on, a line each; `pace` says how fast."""
    timestep = session.program.env.control_timestep
    doing = pace if session.playing else "paused"
    return [
        f"{session.checkpoint}, seed {session.seed}, episode {session.episode}",
        f"{session.length * timestep:.2f} s, step {session.length}, "
        f"return {session.sums.get('reward', 0.0):.4g}",
        doing,
        *([session.ended] if session.ended else []),
    ]
