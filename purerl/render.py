"""Makes a video of a run's policy: `python -m purerl.render RUN [--checkpoint best]`.

RUN is a run's folder. RUN/videos/<update>.mp4 shows the deterministic policy in real time, in the
geometry that each episode really had; RUN/videos/<update>.png shows 16 moments of it on one sheet.
No screen is needed.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from purerl.core.errors import RunError, UserError, leave, tell


@dataclass(frozen=True)
class Options:
    """Makes a video (mp4) and a contact sheet (PNG) of a run's policy, in RUN/videos/."""

    run: Annotated[Path, tyro.conf.Positional]
    """The run's folder, such as runs/ant/seed1."""
    checkpoint: str = "latest"
    """latest, best (highest evaluation return), or an update's number."""
    camera: str = ""
    """A camera's name in the model; by default one that follows the body."""
    episodes: int = 1
    """Episodes, one after the other."""
    seconds: float = 10.0
    """At most so much of each episode [s]."""
    size: str = "640x480"
    """Width x height of a frame [pixels], both even."""
    seed: int = 0
    """Seed of the episodes; never meets a seed of training."""
    engine: Literal["", "auto", "c", "jax", "warp"] = ""
    """Physics engine, where it should not be the run's own."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    from purerl.runs.command_line import parse

    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        options = parse(Options, arguments, "python -m purerl.render")
        command(options)
    except (UserError, RunError) as error:
        return tell(error)
    return 0


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
