"""What the window shows, as a record; `advance(session, events) -> session` is all that happens.

The page and the clock make events: functions of the session, with what they take besides. Nothing
here waits, draws or reads a file.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from purerl.report import episode_pictures, renderer
from purerl.tune.option_numbers import Place
from purerl.tune.view import push as pushes
from purerl.tune.view.program import Moment, Program, Shown, episode_key

SECONDS_KEPT = 8.0  # of an episode, for the plots [s]
MOST_ROWS = 800
MOST_OWED = 0.1  # what a slow computer does not catch up on [s of the clock]
INSTANT = 3  # episodes in a row of one step, after which the window stops


class Row(NamedTuple):
    """One control step, for plots and tables."""

    time: float  # at its end [s]
    reward: float
    metrics: dict[str, float]
    action: np.ndarray  # [A]
    value: float


class Session(NamedTuple):
    """The window's state."""

    program: Program
    brain: Any
    checkpoint: str  # what `brain` is, or who plans, in words
    numbers: dict[Place, int | float]  # the sliders
    limit: int  # control steps of an episode
    seed: int
    # The episode.
    episode: int
    moment: Moment
    picture: episode_pictures.Picture
    rows: tuple[Row, ...] = ()  # the last SECONDS_KEPT
    sums: dict[str, float] = {}  # of the reward and of each metric, over the episode
    length: int = 0  # control steps
    # The controls.
    playing: bool = True
    speed: float = 1.0
    owed: float = 0.0  # simulated time that is still to be played [s]
    grip: pushes.Grip | None = None
    chosen: str = ""  # a checkpoint that has yet to be read
    # What is said.
    ended: str = ""  # how the last episode ended
    trouble: str = ""
    instant: int = 0  # episodes in a row that ended at once


def open_session(program: Program, brain: Any, checkpoint: str, limit: int, seed: int) -> Session:
    """Returns a session at the start of a seed's first episode; `limit` in control steps."""
    numbers = program.fixed | program.live
    moment, picture = program.start(numbers, episode_key(seed, 0))
    return Session(program, brain, checkpoint, numbers, limit, seed, 0, moment, picture)


def to_build(session: Session) -> dict[Place, int | float] | None:
    """Returns the numbers of which a program has to be built; None if the present one serves."""
    fixed = session.program.fixed
    wanted = {place: session.numbers[place] for place in fixed}
    return None if wanted == fixed else session.numbers


Event = tuple[Any, ...]  # a function of this section, and what it takes after the session


def advance(session: Session, events: Iterable[Event]) -> Session:
    """Returns the session after these events, in order."""
    for event in events:
        if not isinstance(event, tuple):
            raise TypeError(f"{type(event).__name__} is no event of a session.")
        happen, *about = event
        session = happen(session, *about)
    return session


# --- events ---


def tick(session: Session, seconds: float) -> Session:
    """So much time has passed on the clock [s]: takes the steps that are due.

    What a slow computer owes beyond MOST_OWED is forgiven.
    """
    if not session.playing:
        return session
    timestep = session.program.env.control_timestep
    most = max(MOST_OWED * session.speed, timestep)
    session = session._replace(owed=min(session.owed + seconds * session.speed, most))
    due = timestep * (1 - 1e-6)  # sums of floats are a little off
    while session.playing and session.owed >= due:
        session = take_step(session._replace(owed=max(0.0, session.owed - timestep)))
    return session


def play(session: Session, on: bool) -> Session:
    """Plays, or pauses."""
    return session._replace(playing=on, owed=0.0, instant=0, trouble="")


def step(session: Session) -> Session:
    """Takes one control step, and then pauses."""
    return take_step(session._replace(playing=False, owed=0.0))


def change(session: Session, field: str, value: Any) -> Session:
    """Sets one field: the `speed`, the checkpoint `chosen`, the `trouble` to tell, or no `grip`."""
    return session._replace(**{field: value})


def next_episode(session: Session) -> Session:
    """Starts the next episode."""
    return start_episode(session, session.episode + 1)


def seed(session: Session, seed: int) -> Session:
    """Starts the first episode of another seed."""
    return start_episode(session._replace(seed=seed), 0)


def slide(session: Session, place: Place, value: int | float) -> Session:
    """Takes another number in the options."""
    return session._replace(numbers=session.numbers | {place: value}, trouble="")


def push(session: Session, dv: tuple[float, float, float]) -> Session:
    """Changes the velocity of the body's root by `dv` [m/s]."""
    model, data = session.program.env.physics.model, _place(session)
    root = renderer.root_body(model)
    return _with_velocity(session, pushes.push(model, data, root, data.subtree_com[root], dv))


def pull(session: Session, body: int, start: Any, target: Any) -> Session:
    """Holds a body at `start` and draws it to `target`, both [3] in the world [m].

    Of a body that is held already, the target moves.
    """
    if session.grip is not None and session.grip.body == body:
        return session._replace(grip=session.grip._replace(target=np.asarray(target)))
    return session._replace(grip=pushes.grip(_place(session), body, start, target))


def take_program(session: Session, program: Program) -> Session:
    """Takes a program for other numbers, which is ready."""
    return start_episode(session._replace(program=program), session.episode)


def take_brain(session: Session, brain: Any, checkpoint: str) -> Session:
    """Takes what was learned, of a checkpoint that has been read."""
    return session._replace(brain=brain, checkpoint=checkpoint, chosen="", trouble="")


def fail(session: Session, why: str) -> Session:
    """Tells, in one line, why what was asked for could not be had, and takes it back."""
    numbers = session.numbers | session.program.fixed
    return session._replace(trouble=why, numbers=numbers, chosen="")


# --- episodes ---


def start_episode(session: Session, episode: int) -> Session:
    """Starts an episode of the session's seed."""
    moment, picture = session.program.start(session.numbers, episode_key(session.seed, episode))
    return session._replace(
        episode=episode, moment=moment, picture=picture, rows=(), sums={}, length=0, grip=None
    )


def take_step(session: Session) -> Session:
    """Takes one control step; an episode that ends makes room for the next."""
    timestep = session.program.env.control_timestep
    if session.grip is not None:
        data = _place(session)
        dqvel = pushes.pull(session.program.env.physics.model, data, session.grip, timestep)
        session = _with_velocity(session, dqvel)
    moment, shown = session.program.step(session.numbers, session.brain, session.moment)
    length = session.length + 1
    why = _end(session, shown, length)
    if not shown.lost:
        metrics = {name: float(value) for name, value in shown.metrics.items()}
        action, value = np.asarray(shown.action), float(shown.value)
        row = Row(length * timestep, float(shown.reward), metrics, action, value)
        session = _with_row(session, row, timestep)._replace(picture=shown.picture)
    session = session._replace(moment=moment, length=length)
    return _finished(session, why, timestep) if why else session._replace(instant=0)


def _with_row(session: Session, row: Row, timestep: float) -> Session:
    kept = min(MOST_ROWS, round(SECONDS_KEPT / timestep))
    new = {"reward": row.reward} | {k: x for k, x in row.metrics.items() if k != "reward"}
    sums = {name: session.sums.get(name, 0.0) + value for name, value in new.items()}
    return session._replace(rows=(*session.rows[1 - kept :], row), sums=sums)


def _end(session: Session, shown: Shown, length: int) -> str:
    """Returns why the episode ends with this step, or ""."""
    ends = {
        "its numbers are NaN or absurd": shown.lost,
        "terminated": shown.terminated,
        "truncated by the environment": shown.truncated,
        "time limit": length >= session.limit,
    }
    return next((why for why, holds in ends.items() if holds), "")


def _finished(session: Session, why: str, timestep: float) -> Session:
    """Says how the episode ended, and starts the next; stops where they all end at once."""
    total, after = session.sums.get("reward", 0.0), session.length * timestep
    ended = f"Episode {session.episode} ended after {after:.2f} s ({why}), return {total:.4g}."
    instant = session.instant + 1 if session.length == 1 else 0
    session = start_episode(session, session.episode + 1)._replace(ended=ended, instant=instant)
    if instant < INSTANT:
        return session
    trouble = (
        f"The environment ends at its first step ({why}), {INSTANT} episodes in a row: change its "
        "options, or the seed, and play on."
    )
    return session._replace(playing=False, trouble=trouble)


def _place(session: Session) -> Any:
    physics = session.moment.env.physics
    return pushes.place(session.program.env.physics.model, physics.qpos, physics.qvel)


def _with_velocity(session: Session, dqvel: np.ndarray) -> Session:
    """Adds to the body's velocities. The policy sees it after the next step, as of a real push."""
    physics = session.moment.env.physics
    qvel = physics.qvel + np.asarray(dqvel, np.float32)
    env = session.moment.env.replace(physics=physics.replace(qvel=qvel))
    return session._replace(moment=session.moment.replace(env=env))
