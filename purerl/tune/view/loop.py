"""The window's clock: plays the session in real time, and has slow work done beside it."""

import socket
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from purerl.checks.user_code import program_errors
from purerl.core.errors import UserError, one_line, reason
from purerl.tune.option_numbers import label
from purerl.tune.view import opening, session as events
from purerl.tune.view.session import Session, advance, to_build

if TYPE_CHECKING:
    from purerl.tune.view.page import Page

FRAME = 1 / 60  # the least time between two frames [s]
LONGEST = 1 / 25  # what is played between two frames, so that slow plans show too [s]
SAY = 0.2  # between two changes of numbers and plots [s]
CAME, LEFT = "A browser shows it.", "The last browser left: paused until one opens the page."
LOOK = 2.0  # between two looks for new checkpoints [s]


def check_port(host: str, port: int) -> None:
    """Raises UserError unless the port can be listened on."""
    try:
        socket.create_server((host, port)).close()
    except (OSError, OverflowError) as error:
        why = reason(error)
        cure = "another --port (0 to 65535), or an address of this machine as --host"
        raise UserError(f"{host}:{port} cannot be listened on ({why}): give {cure}.") from error


class Beside:
    """Slow work in a thread of its own, one piece at a time; it returns an event."""

    def __init__(self) -> None:
        """Starts the thread when there is work."""
        self.pool = ThreadPoolExecutor(1, "purerl-view")
        self.work: Future[Any] | None = None
        self.what, self.since = "", 0.0

    def begin(self, what: str, function: Callable[..., Any], *arguments: Any) -> None:
        """Begins a piece of work, called `what`."""
        self.what, self.since = what, time.perf_counter()
        self.work = self.pool.submit(_told, function, *arguments)

    def finished(self) -> list[Any]:
        """Returns the event of the work that has been done since the last call, or none."""
        if self.work is None or not self.work.done():
            return []
        done, self.work, self.what = self.work, None, ""
        return [done.result()]

    @property
    def words(self) -> str:
        """What it does, and for how long; "" if nothing."""
        return f"{self.what} ({time.perf_counter() - self.since:.0f} s)" if self.what else ""


def _told(function: Callable[..., Any], *arguments: Any) -> Any:
    """Returns the event that work returned, or one that says why it failed."""
    try:
        return function(*arguments)
    except Exception as error:  # a program, a file: whatever goes wrong is said in the page
        return events.fail, one_line(error)


def begin_work(session: Session, source: opening.Source, beside: Beside) -> None:
    """Begins what the session waits for, unless something is being done."""
    if beside.work is not None:
        return
    if session.chosen:
        what = f"reading checkpoint {session.chosen}"
        beside.begin(what, lambda name: (events.take_brain, *source.brain(name)), session.chosen)
    elif numbers := to_build(session):
        fixed = session.program.fixed
        changed = [f"{label(p)} = {numbers[p]:g}" for p in fixed if numbers[p] != fixed[p]]
        work = lambda values: (events.take_program, source.program(values))  # noqa: E731
        beside.begin(f"compiling with {', '.join(changed)}", work, dict(numbers))


class Pace:
    """Counts frames and simulated time against the clock."""

    def __init__(self) -> None:
        """Begins to count."""
        self.since, self.frames, self.steps, self.said = time.perf_counter(), 0, 0, ""

    def words(self, timestep: float) -> str:
        """Returns how fast it goes, over the last second; `timestep` of control [s]."""
        seconds = time.perf_counter() - self.since
        if seconds > 1.0:
            speed, rate = self.steps * timestep / seconds, self.frames / seconds
            self.said = f"{speed:.2f} x real time, {rate:.0f} frames/s"
            self.since, self.frames, self.steps = time.perf_counter(), 0, 0
        return self.said


def play(
    page: "Page", session: Session, source: opening.Source, say: Callable[[str], None],
    stop: Callable[[], bool] = lambda: False,
) -> Session:  # fmt: skip
    """Plays a session until `stop()`, or Ctrl-C; returns it.

    Nothing moves while no browser shows the page. `say` is told when one comes or leaves.
    """
    beside, pace = Beside(), Pace()
    page.build(session, source.checkpoints(), lambda: source.command(page.numbers))
    page.scene.show(session)
    last = said = looked = time.perf_counter()
    watched = False
    while not stop():
        if page.watched != watched:
            watched = page.watched
            say(CAME if watched else LEFT)
        now = time.perf_counter()
        tick = [(events.tick, min(now - last, LONGEST))] if watched else []
        before, last = session, now
        session, failed = _advance(session, [*page.happened(), *beside.finished(), *tick])
        if failed:
            page.set_sliders(session.numbers)
        begin_work(session, source, beside)
        if session.program is not before.program:
            page.scene.show(session)
        elif session.picture is not before.picture:
            page.scene.draw(session)
            pace.frames += 1
            pace.steps += max(1, session.length - before.length)
        if now - said > SAY:
            said, timestep = now, session.program.env.control_timestep
            doing = beside.words or pace.words(timestep)
            page.say(session, doing, source.words(session.numbers))
        if now - looked > LOOK and page.checkpoints is not None:
            looked = now
            page.offer_checkpoints(source.checkpoints())
        time.sleep(max(0.0, FRAME - (time.perf_counter() - now)) if watched else 0.05)
    return session


def _advance(session: Session, happened: list[Any]) -> tuple[Session, bool]:
    """Returns the session after the events, and whether something failed."""
    failed = any(event[0] is events.fail for event in happened)
    try:
        with program_errors():
            return advance(session, happened), failed
    except Exception as error:  # a function of the environment, a push that no body can take
        return session._replace(playing=False, trouble=one_line(error), grip=None), failed
