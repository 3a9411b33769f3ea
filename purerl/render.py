"""Makes a video of a run's policy: `python -m purerl.render RUN [--checkpoint best]`.

RUN is a run's folder. RUN/videos/<update>.mp4 shows the deterministic policy in real time, in the
geometry that each episode really had; RUN/videos/<update>.png shows 16 moments of it on one sheet.
No screen is needed.
"""

import contextlib
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from purerl.core.errors import RunError, UserError, one_line
from purerl.runs.command_errors import leave, tell

SHEET = 4  # rows and columns of the contact sheet
SHEET_WIDTH = 320  # of each of its images [pixels]


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
        render_run(options)
    except (UserError, RunError) as error:
        return tell(error)
    return 0


def render_run(options: Options) -> Path:
    """Writes video and contact sheet; returns the video's path.

    Raises:
      UserError: the run, the checkpoint, the camera or an option is not one.
      RunError: there is no OpenGL, or the files cannot be written.
    """
    width, height = parse_size(options.size)
    for name, least in (("episodes", 1), ("seconds", 0.1)):
        if not getattr(options, name) >= least:
            raise UserError(f"{name} is {getattr(options, name)}; it must be at least {least}.")
    from purerl.report.renderer import Renderer, open_gl

    # First of all: an experiment imports mujoco and dm_control, which look for OpenGL themselves.
    open_gl(width, height).free()

    from purerl.devices.compilation import set_up_jax
    from purerl.report.episode_pictures import episode_pictures, frame_stride, physics_of
    from purerl.runs.run_folder import restore

    set_up_jax(cache=True)
    run = restore(options.run, options.checkpoint, print, options.engine)
    env = run.setup.env
    stride = frame_stride(env.control_timestep)
    try:
        renderer = Renderer(physics_of(env).model, width, height, options.camera)
    except ValueError as error:
        raise UserError(str(error)) from error
    with renderer:
        recording = play(run, options)
        name = file_name(run.saved.meta["update"], options)
        path = options.run / "videos" / f"{name}.mp4"
        episodes = [episode_pictures(recording, i, stride) for i in range(options.episodes)]
        fps = 1.0 / (stride * env.control_timestep)
        write_files(path, draw(renderer, episodes), sum(map(len, episodes)), width, height, fps)
    for line in describe(run, recording):
        print(line)
    print(path)
    return path


def parse_size(size: str) -> tuple[int, int]:
    """Returns (width, height) [pixels] of "640x480"."""
    parts = size.lower().split("x")
    if len(parts) != 2 or not all(part.isdigit() for part in parts):
        raise UserError(f"size is {size!r}; give width x height in pixels, such as 640x480.")
    width, height = map(int, parts)
    if width % 2 or height % 2 or not 16 <= min(width, height) <= max(width, height) <= 4096:
        raise UserError(
            f"size is {size}; width and height must be even and from 16 to 4096 pixels."
        )
    return width, height


def play(run: Any, options: Options) -> Any:
    """Plays the episodes; returns `video.Recording` with numpy arrays."""
    import functools

    import jax

    from purerl.core.keys import Purpose, derive
    from purerl.report.episode_pictures import record

    config, env, network, _ = run.setup
    steps = max(1, round(min(options.seconds / env.control_timestep, config.episode_length)))
    key = derive(jax.random.key(options.seed), Purpose.VIDEO)
    played = jax.jit(
        functools.partial(
            record, config, env, network, num_episodes=options.episodes, num_steps=steps
        )
    )
    return jax.device_get(played(run.saved.state, key))


def file_name(update: int, options: Options) -> str:
    """Returns the files' name without ending: the update, and what is not the default."""
    camera = options.camera.replace("/", "-")
    seed = f"seed{options.seed}" if options.seed else ""
    return "_".join(part for part in (f"{update:012d}", camera, seed) if part)


def draw(renderer: Any, episodes: Sequence[Sequence[Any]]) -> Iterator[Any]:
    """Yields the frame of each picture of each episode, [height, width, 3] uint8."""
    for pictures in episodes:
        renderer.start_episode()
        for picture in pictures:
            yield renderer.draw(picture)


def write_files(
    path: Path, frames: Iterator[Any], number: int, width: int, height: int, fps: float
) -> None:
    """Writes a video of `number` frames and, beside it, its contact sheet; each whole or not."""
    kept: dict[int, Any] = {}
    draft = path.with_name(f".{path.name}")
    try:
        path.parent.mkdir(exist_ok=True)
        frames = keep_some(frames, sheet_frames(number), kept)
        write_video(draft.with_suffix(".mp4"), frames, width, height, fps)
        contact_sheet([kept[i] for i in sheet_frames(number)]).save(draft.with_suffix(".png"))
        draft.with_suffix(".png").replace(path.with_suffix(".png"))
        draft.with_suffix(".mp4").replace(path)
    except OSError as error:
        raise RunError(f"{path} cannot be written: {one_line(error)}") from error
    finally:
        for kind in (".mp4", ".png"):
            with contextlib.suppress(OSError):
                draft.with_suffix(kind).unlink(missing_ok=True)


def write_video(path: Path, frames: Iterator[Any], width: int, height: int, fps: float) -> None:
    """Encodes frames as H.264."""
    import os

    # Else it forks with a hook, which is not safe beside JAX's threads.
    os.environ.setdefault("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1")
    import imageio_ffmpeg
    import numpy as np

    writer = imageio_ffmpeg.write_frames(
        str(path), (width, height), fps=fps, codec="libx264", quality=7, macro_block_size=2,
        ffmpeg_log_level="error",
    )  # fmt: skip
    writer.send(None)
    try:
        for frame in frames:
            writer.send(np.ascontiguousarray(frame))
    finally:
        writer.close()


def sheet_frames(number: int) -> list[int]:
    """Returns which of `number` frames the sheet shows: evenly spaced, first and last included."""
    cells = SHEET * SHEET
    return [round(i * (number - 1) / (cells - 1)) for i in range(cells)]


def keep_some(frames: Iterator[Any], chosen: Sequence[int], kept: dict[int, Any]) -> Iterator[Any]:
    """Passes frames through, and puts the chosen ones into `kept` as small PIL images."""
    from PIL import Image

    for i, frame in enumerate(frames):
        if i in chosen:
            image = Image.fromarray(frame)
            kept[i] = image.resize((SHEET_WIDTH, round(SHEET_WIDTH * image.height / image.width)))
        yield frame


def contact_sheet(images: Sequence[Any]) -> Any:
    """Returns 16 images as one, row by row."""
    from PIL import Image

    width, height = images[0].size
    sheet = Image.new("RGB", (SHEET * width, SHEET * height))
    for i, image in enumerate(images):
        sheet.paste(image, (i % SHEET * width, i // SHEET * height))
    return sheet


def describe(run: Any, recording: Any) -> Iterator[str]:
    """Yields a line for each episode."""
    timestep = run.setup.env.control_timestep
    for i, length in enumerate(recording.length):
        end = "to its end" if recording.over[i] else "cut there"
        yield (
            f"update {run.saved.meta['update']:,}, episode {i + 1}: {length * timestep:.1f} s "
            f"({end}), return {recording.episode_return[i]:.2f}"
        )


if __name__ == "__main__":
    leave(main)
