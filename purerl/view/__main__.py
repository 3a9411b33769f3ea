"""Opens a window on a run: `python -m purerl.view RUN [--port 8080]`.

A page in the browser in which the run's policy drives the body, live. Sliders change the numbers of
the environment's options. The run's folder is only read, and may be training meanwhile.
"""

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass

from purerl.core.errors import UserError
from purerl.runs.command_errors import leave
from purerl.runs.command_line import carry_out
from purerl.runs.options import PlayOptions
from purerl.runs.output import show


@dataclass(frozen=True)
class Options(PlayOptions):
    """Opens a page in which a run's policy drives the body, with sliders for the options."""

    host: str = "127.0.0.1"
    """Where to listen. By default only this machine can open the page; over SSH, forward the port:
    ssh -L 8080:127.0.0.1:8080 MACHINE."""
    port: int = 8080
    """The port to listen on."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return carry_out(Options, command, "python -m purerl.view", arguments)


def has_viser() -> bool:
    """Tells whether the package that draws in the browser is installed."""
    return importlib.util.find_spec("viser") is not None


def command(options: Options) -> None:
    """Opens the page and plays until Ctrl-C."""
    if not has_viser():
        raise UserError(
            "The window needs the package viser: pip install -c constraints.txt -e '.[view]'."
        )
    from purerl.view import opening
    from purerl.view.loop import check_port, play
    from purerl.view.page import Page

    check_port(options.host, options.port)
    session, source, title = opening.of_run(options)
    page = Page(options.host, options.port, title)
    try:
        show(f"{title}: open http://{options.host}:{page.port} in a browser; Ctrl-C ends.")
        play(page, session, source, lambda line: show(line))
    except KeyboardInterrupt:
        show("Closed.")
    finally:
        page.close()


if __name__ == "__main__":
    leave(main)
