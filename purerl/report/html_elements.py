"""HTML as text that is safe by its type: whatever is not `Html` is escaped where it is put in."""

import html
from typing import Any

from purerl.machine.output import printable

VOID = {"img", "input", "meta"}  # elements without an end


class Html(str):
    """Text that is HTML already. Only this module and `page.py`, for its own files, make it."""


def text(value: Any) -> Html:
    r"""Returns any value as HTML that shows it, and does nothing else.

    >>> str(text("<b>\x00"))
    '&lt;b&gt;\\x00'
    """
    return value if isinstance(value, Html) else Html(html.escape(printable(str(value))))


def join(parts: Any) -> Html:
    """Returns parts one after the other, each escaped unless it is HTML."""
    return Html("".join(map(text, parts)))


def element(name: str, /, *inside: Any, **attributes: Any) -> Html:
    """Returns an element.

    Args:
      name: "td".
      inside: text, which is escaped, or HTML.
      attributes: `class_="wide"`, `data_run=3`; True: without a value, None or False: left out.

    >>> str(element("td", "1 < 2", class_="wide", hidden=False))
    '<td class="wide">1 &lt; 2</td>'
    """
    shown = {k.rstrip("_").replace("_", "-"): v for k, v in attributes.items()}
    words = [
        f" {key}" if value is True else f' {key}="{text(value)}"'
        for key, value in shown.items()
        if value is not None and value is not False
    ]
    start = f"<{name}{''.join(words)}>"
    return Html(start if name in VOID else f"{start}{join(inside)}</{name}>")


def table(head: list[Any], rows: list[list[Any]], class_: str = "") -> Html:
    """Returns a table that scrolls sideways where it is wider than the page."""
    above = element("tr", *(element("th", cell, scope="col") for cell in head))
    lines = [
        element("tr", element("th", row[0], scope="row"), *(element("td", c) for c in row[1:]))
        for row in rows
    ]
    whole = element("table", element("thead", above), element("tbody", *lines), class_=class_)
    return element("div", whole, class_="scroll")
