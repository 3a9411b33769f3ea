"""Makes a video of a run's policy: `python -m purerl.render RUN [--checkpoint best]`.

RUN is a run's folder. RUN/videos/<update>.mp4 shows the deterministic policy in real time, in the
geometry that each episode really had; RUN/videos/<update>.png shows 16 moments of it on one sheet.
No screen is needed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from purerl.core.errors import UserError
from purerl.runs.command_errors import leave
from purerl.runs.command_line import carry_out
from purerl.runs.options import PlayOptions


@dataclass(frozen=True)
class Options(PlayOptions):
    """Makes a video (mp4) and a contact sheet (PNG) of a run's policy, in RUN/videos/."""

    camera: str = ""
    """A camera's name in the model; by default one that follows the body."""
    episodes: int = 1
    """Episodes, one after the other."""
    seconds: float = 10.0
    """At most so much of each episode [s]."""
    size: str = "640x480"
    """Width x height of a frame [pixels], both even."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return carry_out(Options, command, "python -m purerl.render", arguments)


def command(options: Options) -> None:
    """Checks the options, makes the video, and prints where it is."""
    from purerl.report.renderer import open_gl, parse_size

    size = parse_size(options.size)
    for name, least in (("episodes", 1), ("seconds", 0.1)):
        if not getattr(options, name) >= least:
            raise UserError(f"{name} is {getattr(options, name)}; it must be at least {least}.")
    # First of all: what follows imports mujoco, which looks for OpenGL itself.
    open_gl(*size).free()

    from purerl.report.video import make_video
    from purerl.runs.loaded_run import load

    run = load(options.run, options.checkpoint, options.engine)
    path, lines = make_video(
        run, options.camera, options.episodes, options.seconds, size, options.seed
    )
    print("\n".join([*lines, str(path)]))


if __name__ == "__main__":
    leave(main)
