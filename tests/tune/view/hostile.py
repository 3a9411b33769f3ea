"""Messages that no page sends, and a window with a plain program behind it that gets them.

python -m tests.tune.view.hostile 1000
"""

import contextlib
import math
import random
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import msgspec
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from purerl.tune.view import loop
from purerl.tune.view.opening import Source
from purerl.tune.view.page import Page
from purerl.tune.view.program import Shown
from purerl.tune.view.session import Session
from tests.tune.view.test_session import opened

Message = dict[str, Any]
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [1, 1, 1], "fov": 1.0,
    "near": 0.01, "far": 1000.0, "image_height": 300, "image_width": 400, "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1],
}  # fmt: skip
DRAG = {
    "type": "SceneNodeDragMessage", "phase": "update", "name": "/world/body/sphere",
    "instance_index": 0, "start_position": [0, 0, 0], "start_screen_pos": [0, 0],
    "end_position": [0, 0, 1], "end_screen_pos": [0, 0], "button": "left", "modifier": None,
    "owner": "",
}  # fmt: skip
UPLOAD = {"source_component_uuid": "", "transfer_uuid": "a"}


class Window:
    """A page that is played in a thread, with the plain program of `test_session`.

    Its title, its command and a term of its reward are called `text`.
    """

    def __init__(self, text: str = "x") -> None:
        self.page, self.ended, self.session = Page("127.0.0.1", 0, text), False, opened()
        program = self.session.program

        def step(*arguments: Any) -> tuple[Any, Shown]:
            after, shown = program.step(*arguments)
            return after, shown._replace(metrics=shown.metrics | {f"reward_{text}": 1.0})

        self.session = self.session._replace(program=program._replace(step=step))
        none = lambda *_: ""  # noqa: E731
        source = Source(lambda _: self.session.program, none, lambda _: text)
        self.thread = threading.Thread(target=self._play, args=(source,), daemon=True)
        self.thread.start()
        self.wait(lambda: hasattr(self.page, "said"))

    def _play(self, source: Source) -> None:
        seen, loop.SAY = Seen(self), 0.01
        try:
            loop.play(seen, self.session, source, lambda _: None, lambda: self.ended)  # type: ignore[arg-type]
        except BaseException as error:
            self.ended = repr(error)
            raise

    def wait(self, so: Any, seconds: float = 30.0) -> None:
        end = time.monotonic() + seconds
        while not so():
            assert time.monotonic() < end, self.session.trouble
            time.sleep(0.01)

    def name(self, label: str) -> str:
        """Returns viser's name of what a person moves."""
        handles = self.page.server.gui._gui_input_handle_from_uuid
        return next(n for n, h in handles.items() if getattr(h, "label", "") == label)

    def lives(self) -> bool:
        """Tells whether it still takes steps for a browser that shows it."""
        before = self.session.length, self.session.episode
        self.page.put(_play, True)
        self.wait(lambda: (self.session.length, self.session.episode) != before)
        return self.thread.is_alive() and not self.ended


def _play(session: Session, on: bool) -> Session:
    return session._replace(playing=on, owed=0.0, instant=0)


class Seen:
    """The page, and what session it was last told of."""

    def __init__(self, window: Window) -> None:
        self.window = window

    def __getattr__(self, name: str) -> Any:
        return getattr(self.window.page, name)

    def say(self, session: Session, doing: str, words: str) -> None:
        self.window.session = session
        self.window.page.say(session, doing, words)


@contextlib.contextmanager
def window(**more: Any) -> Iterator[Window]:
    """Opens a window, and ends it."""
    one = Window(**more)
    try:
        yield one
    finally:
        one.ended = one.ended or True
        one.thread.join(10)
        one.page.close()


def client(address: str, **more: Any) -> ClientConnection:
    """Connects as viser's page does."""
    words = [f"viser-v{viser.__version__}"]
    url = address.replace("http:", "ws:").removesuffix("/")
    return connect(url, subprotocols=words, max_size=None, close_timeout=0.1, **more)  # type: ignore[arg-type]


def move(name: str, **updates: Any) -> Message:
    return {"type": "GuiUpdateMessage", "uuid": name, "updates": updates}


def known(one: Window) -> dict[str, Message | bytes | str]:
    """Returns hostile messages, each with its name."""
    push, seed = one.name("Strength [m/s]"), one.name("Seed")
    return {
        "an infinite push": move(push, value=math.inf),
        "a push of nothing": move(push, value=math.nan),
        "a push beyond its slider": move(push, value=1e7),
        "a push by a text": move(push, value="5"),
        "a seed of 2^64": move(seed, value=2**64 - 1),
        "a seed below 0": move(seed, value=-1),
        "an attribute": move(seed, removed=True),
        "no attribute": move(seed, nothing=1),
        "a speed that is none": move(one.name("Speed"), value="1e9"),
        "a choice that is a list": move(one.name("Direction"), value=["left"]),
        "a control that is none": move("nothing", value=1),
        "the public tunnel": {"type": "ShareUrlRequest"},
        "an upload to a button that takes none": UPLOAD
        | {
            "type": "FileTransferStartUpload", "source_component_uuid": push, "filename": "a",
            "mime_type": "", "part_count": 100, "size_bytes": 1 << 30,
        },
        "a part of an upload": UPLOAD
        | {"type": "FileTransferPart", "part_index": 0, "content": b"x" * 1000},
        "a kind that is none": {"type": "Nothing"},
        "a pull to infinity": DRAG | {"end_position": [0, 0, math.inf]},
        "a place that is a text": DRAG | {"start_position": "abc"},
        "no message": b"\xff\x00",
        "a text": "hello",
        "a field too many": CAMERA | {"more": 1},
    }  # fmt: skip


def any_value(draw: random.Random, depth: int = 0) -> Any:
    """Draws a value of any kind."""
    kinds = [
        lambda: draw.choice([math.inf, math.nan, -math.inf, 1e308, -0.0, 1e-320]),
        lambda: draw.choice([2**63, 2**64 - 1, -(2**63), 0, -1, 2**32]),
        lambda: draw.random() * 10,
        lambda: draw.choice(["", "left", "1", "<script>", "x" * 1000, "\0", "é\x1b[2J"]),
        lambda: draw.choice([None, True, False, b"\x00\xff"]),
        lambda: [any_value(draw, depth + 1) for _ in range(draw.randrange(4))],
        lambda: {str(i): any_value(draw, depth + 1) for i in range(draw.randrange(3))},
    ]
    return draw.choice(kinds[: 5 if depth > 2 else 7])()


def any_message(draw: random.Random, one: Window) -> Message:
    """Draws a message: of any kind that viser knows, or one of the page's own with other values."""
    names = list(one.page.server.gui._gui_input_handle_from_uuid)
    kinds = sorted(viser._messages.Message._subclass_from_type_string())
    told = draw.choice([CAMERA, DRAG, move(draw.choice(names), value=any_value(draw))])
    if draw.random() < 0.3:
        told = {"type": draw.choice(kinds), "uuid": draw.choice(names), "name": "/world"}
    changed = {field: any_value(draw) for field in told if draw.random() < 0.2}
    return told | {
        field: x for field, x in changed.items() if field != "type" or draw.random() < 0.1
    }


def send(connection: ClientConnection, message: Message | bytes | str) -> None:
    told = msgspec.msgpack.encode(message) if isinstance(message, dict) else message
    connection.send(told)


def flood(one: Window, number: int, seed: int) -> None:
    """Sends random messages, by new connections where one is closed; the window must live."""
    draw, connection = random.Random(seed), client(one.page.address)
    for _ in range(number):
        try:
            send(connection, any_message(draw, one))
        except ConnectionClosed:
            connection = client(one.page.address)
    send(connection, CAMERA)
    assert one.lives()
    connection.close()


if __name__ == "__main__":
    with window() as one:
        for seed in range(int(sys.argv[1]) // 100):
            flood(one, 100, seed)
    print(f"{int(sys.argv[1]) // 100 * 100} random messages: the window lives.")
