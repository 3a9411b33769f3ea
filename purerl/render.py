"""Makes a video of a run's policy: `python -m purerl.render RUN [--checkpoint best]`.

RUN is a run's folder, or a policy that comes with purerl, as `ant_gaps`, whose videos go to
videos/ant_gaps/. RUN/videos/<update>.mp4 shows the deterministic policy in real time, in each
episode's own geometry; <update>.png beside it shows 16 moments of it. No screen is needed. Any
option of the environment can be given, and a lesion, as to `ask`; the files are named after them:

    python -m purerl.render ant_gaps --env.arena single_gap --env.gap-length 0.5 0.5
"""

import re
from dataclasses import dataclass
from typing import Any

from purerl.core.errors import UserError, check_least
from purerl.experiment.command_line import main_of_words
from purerl.experiment.options import EpisodeOptions, Lesion
from purerl.machine import command_errors, output
from purerl.report.opengl import open_gl
from purerl.tune import subject

PROG = "python -m purerl.render"


@dataclass(frozen=True)
class RenderOptions(EpisodeOptions):
    """What a video shows: a mp4 and a contact sheet (PNG), in RUN/videos/.

    Those of a policy that comes with purerl go to videos/NAME/.
    """

    camera: str = ""
    """A camera's name or number in the model; by default one that follows the body."""
    episodes: int = 1
    """Episodes, one after the other."""
    seconds: float = 10.0
    """At most so much of each episode [s]."""
    size: str = "640x480"
    """Width x height of a frame [pixels], both even."""
    lesion: Lesion = Lesion()


def command(words: list[str]) -> None:
    """Makes the video, and prints which files it made."""
    # First of all: what follows imports mujoco, which looks for OpenGL itself.
    open_gl(16, 16).free()
    found, experiment, options = subject.one_run(words, PROG, RenderOptions)
    output.show(*make(found.run, experiment, options))


def make(run: Any, experiment: Any, options: RenderOptions) -> list[str]:
    """Makes the video; returns lines about it, the last ones its files.

    Args:
      run: what `load` returned.
      experiment: the run's own, or with another `env`.
      options: the command's.
    """
    from purerl.report import asking
    from purerl.report.video import make_video

    check_least(options, UserError, episodes=1, seconds=0.1)
    size, acting = _parse_size(options.size), asking.acting(run, experiment, options)
    changes = asking.changes(run.experiment, experiment, options)
    output.say("Compiling and playing: for a large body that may take two minutes.")
    path, lines = make_video(run, acting, size, options, changes)
    return [*lines, str(path.with_suffix(".png")), str(path)]


def _parse_size(size: str) -> tuple[int, int]:
    """Returns (width, height) [pixels] of "640x480"."""
    parts = re.fullmatch(r"(\d+)x(\d+)", size.lower())
    if parts is None:
        raise UserError(f"size is {size!r}; give width x height in pixels, such as 640x480.")
    width, height = map(int, parts.groups())
    if width % 2 or height % 2 or not 16 <= min(width, height) <= max(width, height) <= 4096:
        raise UserError(f"size is {size}; width and height must be even, 16 to 4096 pixels.")
    return width, height


main = main_of_words(command, lambda words: subject.show_help(RenderOptions, __doc__, PROG, words))


if __name__ == "__main__":
    command_errors.leave(main)
