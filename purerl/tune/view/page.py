"""The page in the browser, by viser: its controls, plots and tables; `scene.py` draws the body.

What a person does there becomes events of `session.py` in a queue. What the session says is shown.
"""

import contextlib
import io
import itertools
import queue
import secrets
from collections.abc import Callable, Sequence
from typing import Any

import viser

from purerl.report.html_elements import Html
from purerl.report.renderer import seen_by_eyes
from purerl.tune.option_numbers import Place, bounds, label
from purerl.tune.view import gate, readouts, scene, session as events
from purerl.tune.view.session import Session

SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
MOVES = {"Step": events.step, "Next episode": events.next_episode}
WAYS = {"forward": (1, 0, 0), "back": (-1, 0, 0), "left": (0, 1, 0), "right": (0, -1, 0),
        "up": (0, 0, 1)}  # fmt: skip
COLORS = ("#222222", "#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#17becf", "#8c564b")
AS_IN_FILE = "# as in the experiment's file"  # as high as the overrides of one slider
PLOT_HEIGHT, PANEL_WIDTH, EYES_WIDTH = 190, 380, 320  # [pixels]
MOST_EVENTS = 1000  # that wait to be played


class Page:
    """One page, which any number of browsers show."""

    def __init__(self, host: str, port: int, title: str) -> None:
        """Opens the page's server; port 0 is any free one."""
        self.events: queue.SimpleQueue[Any] = queue.SimpleQueue()
        key = secrets.token_urlsafe(16)
        opened = gate.closed(key, self._find, lambda why: self.put(events.change, "trouble", why))
        with contextlib.redirect_stdout(io.StringIO()), opened:  # viser prints a banner
            self.server = viser.ViserServer(host, port, label=title, verbose=False)
        self.port = self.server.get_port()
        self.address = f"http://{host}:{self.port}/{key}/"
        self.server.gui.configure_theme(show_share_button=False, control_width="large")
        self.scene = scene.Scene(self.server, self.put)
        self.sliders: dict[Place, Any] = {}
        self.numbers: dict[Place, Any] = {}  # as the sliders have told them
        self.plots: dict[str, Any] = {}
        self.checkpoints: Any = None
        self.eyes: Any = None

    @property
    def watched(self) -> bool:
        """Whether a browser shows it."""
        return bool(self.server.get_clients())

    def close(self) -> None:
        """Ends the server."""
        self.server.stop()

    def put(self, *event: Any) -> None:
        """Notes an event of `session.py`: a function, and what it takes; of a flood, a part."""
        if self.events.qsize() < MOST_EVENTS:
            self.events.put(event)

    def _find(self, name: str) -> Any:
        return self.server.gui._gui_input_handle_from_uuid.get(name)

    def happened(self) -> list[Any]:
        """Returns the events since the last call."""
        return [self.events.get() for _ in range(self.events.qsize())]

    def build(self, session: Session, checkpoints: Sequence[str], train: Callable[[], str]) -> None:
        """Adds everything that a person moves and reads.

        Args:
          session: the session.
          checkpoints: names to choose among, the first being in use; none: nothing to choose.
        """
        gui, put = self.server.gui, self.put
        self.play = gui.add_button("Pause")
        self.play.on_click(lambda _: put(events.play, self.play.label == "Play"))
        moves = gui.add_button_group("Move on", tuple(MOVES))
        moves.on_click(lambda _: put(MOVES[moves.value]))
        hint = "Simulated seconds in a real one"
        speed = gui.add_dropdown("Speed", SPEEDS, initial_value="1", hint=hint)
        speed.on_update(lambda _: put(events.change, "speed", float(speed.value)))
        follow = gui.add_checkbox("Camera follows", True)
        follow.on_update(lambda _: setattr(self.scene, "follows", follow.value))
        shadows = gui.add_checkbox("Shadows", True, hint="Without: faster where there is no GPU")
        light = self.server.scene.configure_default_lights
        shadows.on_update(lambda _: light(cast_shadow=shadows.value))
        seed = gui.add_number("Seed", session.seed, min=0, max=2**32 - 1, step=1)
        seed.on_update(lambda _: put(events.seed, int(seed.value)))
        if checkpoints:
            names, first = tuple(checkpoints), checkpoints[0]
            self.checkpoints = gui.add_dropdown("Checkpoint", names, initial_value=first)
            chosen = self.checkpoints
            chosen.on_update(lambda _: put(events.change, "chosen", chosen.value))
        self._add_sliders(session, train)
        self._add_push()
        panel = self.server.gui.add_panel()
        self.tab = panel.add_tab("Live")
        with self.tab:  # whatever grows is here, so that no button moves under the mouse
            self.said = self.server.gui.add_html("opening")
        self.server.gui.main_panel.dock_right()
        panel.dock_left()
        panel.set_width(PANEL_WIDTH)

    def _add_push(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Push (or drag the body with the mouse)"):
            way = gui.add_dropdown("Direction", tuple(WAYS), initial_value="left")
            hard = gui.add_slider("Strength [m/s]", 0.1, 5.0, 0.1, 1.0)

            @gui.add_button("Push").on_click
            def _(_: Any) -> None:
                x, y, z = (hard.value * part for part in WAYS[way.value])
                self.put(events.push, (x, y, z))

    def _add_sliders(self, session: Session, train: Callable[[], str]) -> None:
        gui, live = self.server.gui, session.program.live
        with gui.add_folder("Options of the environment"):
            self.words = gui.add_html("This environment's options have no numbers.")
            button = gui.add_button("Train this", hint="Shows the command that trains it")
            told = gui.add_html("", visible=False)

            @button.on_click
            def _(_: Any) -> None:
                _show(told, readouts.as_typed(train()))
                told.visible = True

            for place in live:
                self._add_slider(place, session.numbers[place], "acts at once")
        others = [place for place in session.numbers if place not in live]
        if others:
            with gui.add_folder("Options that build the environment anew"):
                for place in others:
                    self._add_slider(place, session.numbers[place], "takes seconds; a new episode")

    def _add_slider(self, place: Place, value: Any, hint: str) -> None:
        least, greatest, step = bounds(value)
        slider = self.server.gui.add_slider(
            label(place), min=least, max=greatest, step=step, initial_value=value, hint=hint
        )
        slider.on_update(lambda _: self._slid(place, slider.value))
        self.sliders[place], self.numbers[place] = slider, value

    def _slid(self, place: Place, value: float) -> None:
        """Tells a slider's move, but for one that `set_sliders` made."""
        if value != self.numbers[place]:
            self.numbers[place] = value
            self.put(events.slide, place, value)

    def set_sliders(self, numbers: dict[Place, Any]) -> None:
        """Sets the sliders back to the numbers that are in use."""
        for place, slider in self.sliders.items():
            if self.numbers[place] != numbers[place]:
                self.numbers[place] = numbers[place]
                slider.value = numbers[place]

    def offer_checkpoints(self, names: Sequence[str]) -> None:
        """Shows which checkpoints there are now; the chosen one stays."""
        names = tuple(dict.fromkeys([*names, self.checkpoints.value]))
        if names != tuple(self.checkpoints.options):
            self.checkpoints.options = names

    def say(self, session: Session, doing: str, words: str) -> None:
        """Shows numbers, plots and lines.

        Args:
          session: the session.
          doing: what is going on, such as how fast.
          words: the overrides that make the sliders' setting.
        """
        self.play.label = "Pause" if session.playing else "Play"
        _show(self.said, readouts.said(session, doing))
        if self.sliders:
            _show(self.words, readouts.as_typed(words or AS_IN_FILE))
        self._draw_plots(session)
        self._draw_eyes(session)

    def _draw_eyes(self, session: Session) -> None:
        """Shows what the body's eyes see, if it has some."""
        if not session.picture.eyes:
            return
        seen = seen_by_eyes(session.picture, EYES_WIDTH)
        if self.eyes is None:
            with self.tab:
                self.eyes = self.server.gui.add_image(seen, label="Eyes")
        self.eyes.image = seen

    def _draw_plots(self, session: Session) -> None:
        """Draws the lines; with fewer than two points uPlot has no scale, and they stay."""
        for title, plot in readouts.plots(session).items():
            if len(plot.columns[0]) < 2:
                continue
            series = _series(plot.names)
            if title not in self.plots:
                with self.tab:
                    self.plots[title] = self.server.gui.add_uplot(
                        data=plot.columns, series=series, title=title,
                        height=PLOT_HEIGHT, scales={"x": {"time": False}},
                        legend={"show": len(plot.names) <= len(COLORS)},
                    )  # fmt: skip
            shown = self.plots[title]
            shown.data = plot.columns
            if shown.series != series:
                shown.series = series


def _series(names: Sequence[str]) -> tuple[Any, ...]:
    """Returns how viser's plot is to draw the time and each line."""
    each = zip(names, itertools.cycle(COLORS), strict=False)
    return ({"label": "s"}, *({"label": n, "stroke": color, "width": 1.5} for n, color in each))


def _show(element: Any, content: Html) -> None:
    """Sets what an element shows, if it is another: by its type no text of a file or a client."""
    if element.content != content:
        element.content = str(content)
