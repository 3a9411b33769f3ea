"""Who may speak to the window, and what: viser itself believes everybody and every message.

The page's address holds a key, new at each start. Without it a connection is refused, whatever its
Origin and Host are: another page in the browser, a name that leads here and another user of this
machine do not know it. Of a message that the page offers, what was checked is handed on.
"""

import asyncio
import contextlib
import json
import secrets
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
from viser import _messages as messages
from websockets.asyncio import server as websockets

from purerl.core.errors import one_line

OFFERED = ("GuiUpdateMessage", "SceneNodeDragMessage", "ViewerCameraMessage")
LARGEST = 1 << 16  # [bytes] of a message
PAUSE = 0.002  # after each message, so that a connection has at most 500 a second [s]


@contextlib.contextmanager
def closed(key: str, find: Callable[[str], Any], refuse: Callable[[str], None]) -> Iterator[None]:
    """Stands before the server that viser opens meanwhile.

    Args:
      key: what every address begins with.
      find: returns what can be moved, by viser's name of it; None if there is none.
      refuse: told, in one line, why a message is not handed on.
    """
    serve: Any = websockets.serve

    def enter(connection: Any, request: Any) -> Any:
        given, _, path = request.path.removeprefix("/").partition("/")
        request.path, has_key = f"/{path}", secrets.compare_digest(given.encode(), key.encode())
        return None if has_key else connection.respond(403, "Open the whole address.\n")

    async def next_checked(receive: Callable[[], Any]) -> bytes:
        while True:
            raw = await receive()
            await asyncio.sleep(PAUSE)
            try:
                return check(raw, find)
            except Exception as error:  # of a decoder too
                refuse(f"A browser sent what this page does not offer: {one_line(error):.200}")

    def behind(handler: Any, *place: Any, process_request: Any, **more: Any) -> Any:
        def handle(one: Any) -> Any:
            receive, one.recv = one.recv, lambda: next_checked(receive)
            return handler(one)

        more["process_request"] = lambda *who: enter(*who) or process_request(*who)
        return serve(handle, *place, **more | {"max_size": LARGEST})

    websockets.serve = behind  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.serve = serve  # type: ignore[misc]


def check(raw: bytes, find: Callable[[str], Any]) -> bytes:
    """Returns what the page offers of a message; raises an error if it does not offer that."""
    given = msgspec.msgpack.decode(raw)
    kind = {name: getattr(messages, name) for name in OFFERED}[given["type"]]
    message = msgspec.to_builtins(msgspec.convert(given, kind))
    json.dumps(message, allow_nan=False)  # ValueError: a number is not finite
    for name, value in message.get("updates", {}).items():
        if name != "value" or not fits(find(message["uuid"]), value):
            raise ValueError(f"no control has {name} {value!r:.60}")
    return msgspec.msgpack.encode(message | {"type": given["type"]})


def fits(control: Any, value: Any) -> bool:
    """Tells whether a control of viser can be moved to a value; TypeError if it is of no kind.

    A button or a box is False or True.
    """
    if hasattr(control, "options"):
        return value in control.options
    return getattr(control, "min", False) <= value <= getattr(control, "max", control is not None)
