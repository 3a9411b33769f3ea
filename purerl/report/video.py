"""Videos of a run's policy: an mp4 and a contact sheet of each, drawn without a screen."""

import contextlib
import functools
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from PIL import Image

from purerl.core.errors import RunError, UserError, one_line
from purerl.core.keys import Purpose, derive
from purerl.report.episode_pictures import (
    Recording,
    episode_pictures,
    frame_stride,
    physics_of,
    record,
)
from purerl.report.renderer import Renderer
from purerl.runs.loaded_run import Run

SHEET = 4  # rows and columns of the contact sheet
SHEET_WIDTH = 320  # of each of its images [pixels]


def make_video(
    run: Run,
    camera: str = "",
    episodes: int = 1,
    seconds: float = 10.0,
    size: tuple[int, int] = (640, 480),
    seed: int = 0,
) -> tuple[Path, list[str]]:
    """Plays episodes by the deterministic policy, and writes a video and a contact sheet of them.

    Args:
      run: the run; the files go to its folder's videos/.
      camera: a camera's name in the model; "": one that follows the body.
      episodes: how many, one after the other.
      seconds: at most so much of each [s].
      size: width and height of a frame [pixels].
      seed: of the episodes.

    Returns:
      The video's path, and a line about each episode.

    Raises:
      UserError: the run, the checkpoint or the camera is not one.
      RunError: there is no OpenGL, or the files cannot be written.
    """
    env, (width, height) = run.env, size
    stride = frame_stride(env.control_timestep)
    try:
        renderer = Renderer(physics_of(env).model, width, height, camera)
    except ValueError as error:
        raise UserError(str(error)) from error
    with renderer:
        recording = play(run, episodes, seconds, seed)
        path = run.folder / "videos" / f"{file_name(run.update, camera, seed)}.mp4"
        pictures = [episode_pictures(recording, i, stride) for i in range(episodes)]
        fps = 1.0 / (stride * env.control_timestep)
        write_files(path, draw(renderer, pictures), sum(map(len, pictures)), width, height, fps)
    return path, list(describe(run, recording))


def play(run: Run, episodes: int, seconds: float, seed: int) -> Recording:
    """Plays episodes of at most `seconds` [s]; returns their pictures as numpy arrays."""
    config, env, network = run.config, run.env, run.network
    steps = max(1, round(min(seconds / env.control_timestep, config.episode_length)))
    key = derive(jax.random.key(seed), Purpose.VIDEO)
    played = jax.jit(
        functools.partial(record, config, env, network, num_episodes=episodes, num_steps=steps)
    )
    return jax.device_get(played(run.state, key))


def file_name(update: int, camera: str, seed: int) -> str:
    """Returns the files' name without ending: the update, and what is not the default."""
    parts = (f"{update:012d}", camera.replace("/", "-"), f"seed{seed}" if seed else "")
    return "_".join(part for part in parts if part)


def draw(renderer: Renderer, episodes: Sequence[Sequence[Any]]) -> Iterator[Any]:
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
    # Else it forks with a hook, which is not safe beside JAX's threads.
    os.environ.setdefault("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1")
    import imageio_ffmpeg

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
    for i, frame in enumerate(frames):
        if i in chosen:
            image = Image.fromarray(frame)
            kept[i] = image.resize((SHEET_WIDTH, round(SHEET_WIDTH * image.height / image.width)))
        yield frame


def contact_sheet(images: Sequence[Any]) -> Any:
    """Returns 16 images as one, row by row."""
    width, height = images[0].size
    sheet = Image.new("RGB", (SHEET * width, SHEET * height))
    for i, image in enumerate(images):
        sheet.paste(image, (i % SHEET * width, i // SHEET * height))
    return sheet


def describe(run: Run, recording: Recording) -> Iterator[str]:
    """Yields a line for each episode."""
    timestep = run.env.control_timestep
    for i, length in enumerate(recording.length):
        end = "to its end" if recording.over[i] else "cut there"
        yield (
            f"update {run.update:,}, episode {i + 1}: {length * timestep:.1f} s "
            f"({end}), return {recording.episode_return[i]:.2f}"
        )
