"""Makes a video of a run's policy: `python -m purerl.render RUN [--checkpoint best]`.

RUN is a run's folder, or a policy that comes with purerl, as `ant_gaps`, whose videos go to
videos/ant_gaps/. RUN/videos/<update>.mp4 shows the deterministic policy in real time, in each
episode's own geometry; <update>.png beside it shows 16 moments of it. No screen is needed.
"""

import re
from dataclasses import dataclass

from purerl.core.errors import UserError, check_least
from purerl.experiment.command_line import main_of
from purerl.experiment.options import PlayOptions
from purerl.machine import command_errors, output


@dataclass(frozen=True)
class RenderOptions(PlayOptions):
    """Makes a video (mp4) and a contact sheet (PNG) of a run's policy, in RUN/videos/.

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


def command(options: RenderOptions) -> None:
    """Makes the video, and prints which files it made."""
    output.show(*make(options))


def make(options: RenderOptions) -> list[str]:
    """Checks the options and makes the video; returns lines about it, the last ones its files."""
    from purerl.report.opengl import open_gl

    size = _parse_size(options.size)
    check_least(options, UserError, episodes=1, seconds=0.1)
    # First of all: what follows imports mujoco, which looks for OpenGL itself.
    open_gl(*size).free()

    from purerl.report.video import make_video
    from purerl.runs.loaded_run import load

    run = load(options.run, options.checkpoint, options.engine, options.trust)
    output.say("Compiling and playing: for a large body that may take two minutes.")
    about = (options.camera, options.episodes, options.seconds, size, options.seed)
    path, lines = make_video(run, *about)
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


main = main_of(RenderOptions, command, "python -m purerl.render")


if __name__ == "__main__":
    command_errors.leave(main)
