"""Opens a window on a run or an experiment: `python -m purerl.view EXPERIMENT_OR_RUN`.

A page in the browser in which a run's policy drives the body, live; an experiment's body, the
planner. `ant_gaps` and other policies that come with purerl are played by their names. Sliders
change the numbers of the environment's options, which begin as they are given:

    python -m purerl.view suite --env.task hopper-hop

A run's folder is only read, and may be training meanwhile.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from purerl.experiment.command_line import main_of_words
from purerl.machine import command_errors, output
from purerl.tune.subject import PlanOptions, chosen as settings_of, find, show_help

PROG = "python -m purerl.view"


@dataclass(frozen=True)
class ViewOptions(PlanOptions):
    """Who drives the body, and where the page is."""

    drive: Literal["", "policy", "planner"] = ""
    """Who chooses the actions; by default a run's policy, and the planner of an experiment. Of a
    run, plans correct its policy's actions, and its value counts at the horizon."""
    host: str = "127.0.0.1"
    """Where to listen: by default this machine alone; over SSH, forward the port:
    ssh -L 8080:127.0.0.1:8080 MACHINE. Only who has the whole address can open the page."""
    port: int = 8080
    """The port to listen on."""


def command(words: Sequence[str]) -> None:
    """Opens the page and plays until Ctrl-C."""
    found = find(words, PROG, policies=True)
    chosen, options = settings_of(found, words[1:], PROG, ViewOptions)
    command_errors.check_installed("viser", "view")  # its help needs no window
    from purerl.tune.view import opening
    from purerl.tune.view.loop import check_port, play
    from purerl.tune.view.page import Page

    check_port(options.host, options.port)
    session, source, title = opening.open_window(found, chosen, options)
    page = Page(options.host, options.port, title)
    try:
        output.show(f"{title}: open {page.address} in a browser; Ctrl-C ends.")
        play(page, session, source, lambda line: output.show(line))
    except KeyboardInterrupt:
        output.show("Closed.")
    finally:
        page.close()


main = main_of_words(command, lambda words: show_help(ViewOptions, __doc__, PROG, words))


if __name__ == "__main__":
    command_errors.leave(main)
