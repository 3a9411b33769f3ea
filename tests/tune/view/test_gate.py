"""Who gets into the window, and what a browser's messages can do there."""

import contextlib
import functools
import http.server
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.report import chromium

pytest.importorskip("viser", reason="pip install -e '.[view]'")

from websockets.exceptions import InvalidStatus

from purerl.tune.view import session as events
from tests.tune.view import hostile
from tests.tune.view.test_window import GL, needs_chromium


@pytest.fixture(scope="module")
def one():
    with hostile.window() as found:
        yield found


@pytest.fixture(scope="module")
def watched(one):
    with hostile.client(one.page.address) as connection:
        hostile.send(connection, hostile.CAMERA)
        one.wait(lambda: one.session.length > 0)
        yield connection


def test_without_the_key_nothing_comes_in(one):
    root = f"http://127.0.0.1:{one.page.server.get_port()}/"
    for wrong in (root, root + "x/", root + "%2e%2e/", one.page.address[:-2]):
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(wrong)
        # A name that leads here (DNS rebinding) has Origin and Host that agree.
        for headers in ({}, {"Host": "evil.example", "Origin": "http://evil.example"}):
            with pytest.raises(InvalidStatus, match="403"):
                hostile.client(wrong, additional_headers=headers)
    with urllib.request.urlopen(one.page.address) as page:
        assert b"<!doctype html>" in page.read(1000)


NAMES = [
    "an infinite push", "a push of nothing", "a push beyond its slider", "a push by a text",
    "a seed of 2^64", "a seed below 0", "an attribute", "no attribute", "a speed that is none",
    "a choice that is a list", "a control that is none", "the public tunnel",
    "an upload to a button that takes none", "a part of an upload", "a kind that is none",
    "a pull to infinity", "a place that is a text", "no message", "a text",
]  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_what_the_page_does_not_offer_is_told_in_it(one, watched, name):
    one.page.put(events.change, "trouble", "")
    one.wait(lambda: not one.session.trouble)
    hostile.send(watched, hostile.known(one)[name])
    one.wait(lambda: "A browser sent what this page does not offer: " in one.session.trouble)
    assert one.session.seed == 3 and one.lives()


def test_what_it_offers_is_done(one, watched):
    one.page.put(events.change, "trouble", "")
    hostile.send(watched, hostile.move(one.name("Seed"), value=7))
    one.wait(lambda: one.session.seed == 7)
    hostile.send(watched, hostile.move(one.name("Speed"), value="4"))
    one.wait(lambda: one.session.speed == 4.0)
    hostile.send(watched, hostile.known(one)["a field too many"])
    assert one.lives() and not one.session.trouble


def test_random_messages_and_a_large_one_do_not_end_it(one):
    hostile.flood(one, 100, 0)
    with hostile.client(one.page.address) as connection:
        hostile.send(connection, b"x" * (1 << 20))
        one.wait(lambda: connection.protocol.state.name != "OPEN")


SAID = "<img src=x onerror=window.hit=1><iframe srcdoc='<script>parent.hit=1</script>'></iframe>"


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serves a folder as another page of the same machine."""
    kind = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(folder))
    kind.log_message = lambda *_: None
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), kind) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.mark.slow
@needs_chromium
def test_in_a_browser_no_text_acts_and_no_other_page_gets_in(tmp_path):
    with hostile.window(text=SAID) as one, served(tmp_path) as other:
        port, key = one.page.server.get_port(), one.page.address.split("/")[-2]
        (tmp_path / "index.html").write_text(
            "<script>window.said = []; for (const end of ['', '/x', '/?key'])"
            f" for (const name of ['127.0.0.1', 'localhost']) {{ const s = new WebSocket("
            f"`ws://${{name}}:{port}${{end}}`, ['viser-v{hostile.viser.__version__}']);"
            " s.onopen = s.onmessage = () => said.push('in'); s.onerror = () => said.push('out') }"
            "</script>"
        )
        with chromium.browser(*GL) as browser:
            browser.open(f"{other}/index.html")
            one.wait(lambda: len(browser.value("said")) == 6)
            assert set(browser.value("said")) == {"out"} and not one.page.watched
            browser.open(one.page.address, 920, 320)
            text = lambda: browser.value("document.body.innerText")  # noqa: E731
            one.wait(lambda: "step " in text(), 60)
            assert not one.session.trouble  # all that viser's page sends by itself is offered
            one.page.put(events.fail, SAID)
            browser.value("[...document.querySelectorAll('button')]"
                          ".find(e => e.textContent == 'Train this').click()")  # fmt: skip
            # The trouble, the command, the panel's title; in the table, the plot and its legend.
            one.wait(lambda: text().count("onerror=window.hit=1") >= 5, 60)
            assert not browser.value("window.hit || document.querySelectorAll('iframe').length")
            assert key not in browser.value("document.referrer + document.cookie")
