"""A headless Chromium, spoken to through two pipes: no driver and no package is needed."""

import base64
import contextlib
import json
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    "--headless", "--remote-debugging-pipe", "--no-sandbox", "--disable-gpu", "--no-first-run",
    "--disable-dev-shm-usage", "--disable-background-networking", "--hide-scrollbars",
)  # fmt: skip


def find() -> str | None:
    return next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """One page. `said` has what it logged, threw or was refused."""

    def __init__(self, write: int, read: int) -> None:
        self.to, self.answers = os.fdopen(write, "wb"), os.fdopen(read, "rb")
        self.number, self.buffer, self.session, self.events = 0, b"", None, []
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.ask(f"{domain}.enable")

    def _read(self) -> dict:
        while b"\0" not in self.buffer:
            part = self.answers.read1(1 << 20)
            assert part, "Chromium has ended"
            self.buffer += part
        text, _, self.buffer = self.buffer.partition(b"\0")
        return json.loads(text)

    def ask(self, method: str, **params) -> dict:
        self.number += 1
        message = {"id": self.number, "method": method, "params": params}
        message |= {"sessionId": self.session} if self.session else {}
        self.to.write(json.dumps(message).encode() + b"\0")
        self.to.flush()
        while (answer := self._read()).get("id") != self.number:
            self.events.append(answer)
        assert "result" in answer, answer
        return answer["result"]

    def open(self, path: Path | str, width: int = 1240, height: int = 900) -> None:
        """Opens a file, or an address."""
        self.size(width, height)
        before = len(self.events)
        url = path if isinstance(path, str) else path.absolute().as_uri()
        self.ask("Page.navigate", url=url)
        while not any(e.get("method") == "Page.loadEventFired" for e in self.events[before:]):
            self.events.append(self._read())

    def size(self, width: int, height: int) -> None:
        about = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.ask("Emulation.setDeviceMetricsOverride", **about)

    def media(self, scheme: str, kind: str = "") -> None:
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self.ask("Emulation.setEmulatedMedia", media=kind, features=features)

    def value(self, code: str):
        found = self.ask("Runtime.evaluate", expression=code, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def _mouse(self, kind: str, x: float, y: float, **more) -> None:
        self.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def point(self, selector: str, across: float = 0.5) -> None:
        """Brings the pointer over an element, that far from its left side to its right."""
        box = self.value(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)}); "
            "e.scrollIntoView({block: 'center'}); const b = e.getBoundingClientRect(); "
            "return [b.left, b.top, b.width, b.height] })()"
        )
        self.at = box[0] + across * box[2], box[1] + box[3] / 2
        self._mouse("mouseMoved", *self.at)

    def click(self, selector: str) -> None:
        self.point(selector)
        for kind in ("mousePressed", "mouseReleased"):
            self._mouse(kind, *self.at, button="left", clickCount=1)

    def drag(self, path: list[tuple[float, float]]) -> None:
        """Draws the pointer from place to place [pixels], its button held."""
        self._mouse("mouseMoved", *path[0])
        self._mouse("mousePressed", *path[0], button="left", clickCount=1)
        for place in path[1:]:
            self._mouse("mouseMoved", *place, button="left", buttons=1)

    def drop(self, place: tuple[float, float]) -> None:
        self._mouse("mouseReleased", *place, button="left", clickCount=1)

    def picture(self, path: Path, whole: bool = True) -> None:
        found = self.ask("Page.captureScreenshot", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(found["data"]))

    @property
    def said(self) -> list[dict]:
        kinds = {"Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded"}
        return [event for event in self.events if event.get("method") in kinds]

    @property
    def requested(self) -> list[str]:
        kind = "Network.requestWillBeSent"
        return [e["params"]["request"]["url"] for e in self.events if e.get("method") == kind]


@contextlib.contextmanager
def browser(*flags: str):
    """Starts Chromium, with more flags, and ends it."""
    theirs_in, write = os.pipe()
    read, theirs_out = os.pipe()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as home:
        # It reads from file 3 and writes to file 4.
        code = f'exec "$@" 3<&{theirs_in} 4>&{theirs_out}'
        words = ["bash", "-c", code, "chromium", find(), *FLAGS, *flags, f"--user-data-dir={home}"]
        process = subprocess.Popen(
            words, pass_fds=(theirs_in, theirs_out), stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(theirs_in)
        os.close(theirs_out)
        try:
            one = Browser(write, read)
            yield one
            one.to.close()
        finally:
            process.terminate()
            process.wait(30)
