"""Videos of a run's policy: an mp4 and a contact sheet of each, drawn without a screen."""

import contextlib
import os
import re
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from PIL import Image

from purerl.core.errors import RunError, UserError, one_line
from purerl.core.keys import Purpose, derive
from purerl.core.records import TrainState
from purerl.experiment import loading
from purerl.experiment.objects import Setup
from purerl.experiment.options import check_seed
from purerl.machine.files import check_inside
from purerl.report import run_reader
from purerl.report.episode_pictures import Recording, episode_pictures, frame_stride, record
from purerl.report.page_series import RETURN
from purerl.report.renderer import Renderer, model_of
from purerl.runs.loaded_run import Run

Size = tuple[int, int]  # width and height [pixels]
Acting = tuple[Setup, TrainState]  # a policy with its state, and its environment
SHEET = 4  # rows and columns of the contact sheet
SHEET_WIDTH = 320  # of each of its images [pixels]


def make_video(
    run: Run, acting: Acting, size: Size, options: Any, changes: Sequence[str] = ()
) -> tuple[Path, list[str]]:
    """Plays episodes by the deterministic policy, and writes a video and a contact sheet of them.

    Args:
      run: the run; the files go to `videos_of` its folder.
      acting: who acts and where.
      size: width and height of a frame [pixels].
      options: of `render`: a camera, episodes, seconds of each, and their seed.
      changes: what is not as usual, as `a: old -> new`; the files are named after it.

    Returns:
      The video's path, and a line about each episode and, in the run's own environment, one about
      the last evaluation.

    Raises:
      UserError: the run, the checkpoint or the camera is not one.
      RunError: there is no OpenGL, or the files cannot be written.
    """
    env = acting[0].env
    # The files are named after the update, and after what is not the default.
    words = [f"{run.update:012d}", *changes]
    name = "_".join(re.sub(r"(: .* -> |[^\w.,-])+", "-", word).strip("-") for word in words)
    path = videos_of(run.folder) / f"{name}.mp4"
    with renderer_of(env, size, options.camera) as renderer:
        recording = _play(acting, options.episodes, options.seconds, options.seed)
        draw(path, renderer, recording, env.control_timestep)
    told = zip(recording.length, recording.over, recording.episode_return, strict=True)
    lines = [
        f"update {run.update:,}, episode {i + 1}: {length * env.control_timestep:.1f} s "
        f"({'to its end' if over else 'cut there'}), return {episode_return:.2f}"
        for i, (length, over, episode_return) in enumerate(told)
    ]
    whole = [float(value) for value in recording.episode_return[recording.over]]
    with contextlib.suppress(UserError):  # metrics that cannot be read spoil no video
        if not any(line.startswith(("env.", "lesion.")) for line in changes):
            lines += beside_evaluation(run_reader.read(run.folder).lines, run.update, whole)
    return path, lines


def frames(
    run: Run, camera: str | int = "", seconds: float = 10.0, size: Size = (320, 240), seed: int = 0
) -> tuple[np.ndarray, float]:
    """Plays an episode by the deterministic policy, and draws it, without a screen or a file.

    Args:
      run: the run, as `load` and `train` return it.
      camera: a camera's name or number in the model; "": one that follows the body.
      seconds: at most so much of the episode [s].
      size: width and height of a frame [pixels].
      seed: of the episode.

    Returns:
      Pictures [F, height, width, 3] uint8, and how many of them make a second.

    Raises:
      UserError: the environment cannot be drawn, or an argument is out of its range.
      RunError: there is no OpenGL; the message says what to install.
    """
    check_seed(seed)
    if not (seconds >= 0.1 and 16 <= min(size) <= max(size) <= 4096):
        raise UserError(f"seconds is {seconds}, size {size}: at least 0.1, and 16 to 4096 pixels.")
    timestep = run.env.control_timestep
    stride = frame_stride(timestep)
    with renderer_of(run.env, size, str(camera)) as renderer:
        acting = run.restored.setup, run.state
        pictures = episode_pictures(_play(acting, 1, seconds, seed), 0, stride)
        return np.stack(list(renderer.draw_episode(pictures))), 1.0 / (stride * timestep)


def videos_of(folder: Path) -> Path:
    """Returns the folder of a run's videos; UserError if it is a link to elsewhere.

    Of a policy that comes with the library it is videos/NAME in the folder of the process.
    """
    if loading.is_shipped(folder):
        return Path("videos", folder.name)
    check_inside(folder, folder / "videos")
    return folder / "videos"


def renderer_of(env: Any, size: tuple[int, int], camera: str = "") -> Renderer:
    """Returns a renderer for an environment, to be used in a `with`; see `make_video`."""
    model = model_of(env)
    try:
        return Renderer(model, *size, camera)
    except ValueError as error:
        raise UserError(str(error)) from error


def draw(path: Path, renderer: Renderer, recording: Recording, timestep: float) -> None:
    """Writes the video of recorded episodes with steps of `timestep` [s], and a contact sheet."""
    stride, size = frame_stride(timestep), (renderer.size.width, renderer.size.height)
    episodes = range(len(recording.length))
    pictures = [episode_pictures(recording, i, stride) for i in episodes]
    frames = (frame for each in pictures for frame in renderer.draw_episode(each))
    _write_files(path, frames, sum(map(len, pictures)), size, 1.0 / (stride * timestep))


def beside_evaluation(
    lines: Sequence[dict[str, Any]], update: int, whole: Sequence[float]
) -> list[str]:
    """Returns a line that holds episodes' returns against the last evaluation; [] without one.

    Args:
      lines: of metrics.jsonl.
      update: the checkpoint's; what came later is not looked at.
      whole: returns of the episodes that came to their end.
    """
    known = [line for line in lines if line["update"] <= update and line.get(RETURN) is not None]
    if not known:
        return []
    mean, std, low, high = (known[-1].get(f"{RETURN}{end}") for end in ("", "_std", "_min", "_max"))
    if std is None or low is None or high is None:
        return []
    among = sum(low <= value <= high for value in whole)
    said = f"evaluation after update {known[-1]['update']:,}: return {mean:.2f} +- {std:.2f}, "
    said += f"from {low:.2f} to {high:.2f}; "
    if not whole:
        return [said + "no episode above came to its end, so none can be compared with it"]
    return [said + f"whole episodes above in that range: {among} of {len(whole)}"]


def _play(acting: Acting, episodes: int, seconds: float, seed: int) -> Recording:
    """Plays episodes of at most `seconds` [s]; returns their pictures as numpy arrays."""
    setup, state = acting
    steps = max(1, round(min(seconds / setup.env.control_timestep, setup.config.episode_length)))
    key = derive(jax.random.key(seed), Purpose.VIDEO)
    played = jax.jit(lambda state, key: record(setup, state, key, episodes, steps))
    return jax.device_get(played(state, key))


def _write_files(
    path: Path, frames: Iterable[np.ndarray], number: int, size: tuple[int, int], fps: float
) -> None:
    """Writes a video of `number` frames and, beside it, its contact sheet; each whole or not."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".", dir=path.parent) as place:
            draft = Path(place, path.name)
            _write_video(draft, frames, number, size, fps).save(draft.with_suffix(".png"))
            for kind in (".png", ".mp4"):
                draft.with_suffix(kind).replace(path.with_suffix(kind))
    except OSError as error:
        raise RunError(f"{path} cannot be written: {one_line(error)}") from error


def _write_video(
    path: Path, frames: Iterable[np.ndarray], number: int, size: tuple[int, int], fps: float
) -> Image.Image:
    """Encodes frames as H.264; returns their contact sheet."""
    # Else it forks with a hook, which is not safe beside JAX's threads.
    os.environ.setdefault("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1")
    import imageio_ffmpeg

    shown = np.linspace(0, number - 1, SHEET * SHEET).round()  # in each cell, the frame's number
    width, height = SHEET_WIDTH, round(SHEET_WIDTH * size[1] / size[0])
    sheet = Image.new("RGB", (SHEET * width, SHEET * height))
    writer = imageio_ffmpeg.write_frames(
        str(path.absolute()), size, fps=fps, codec="libx264", quality=7, macro_block_size=2,
        ffmpeg_log_level="error",
    )  # fmt: skip
    writer.send(None)
    try:
        for i, frame in enumerate(frames):
            writer.send(np.ascontiguousarray(frame))
            for cell in np.flatnonzero(shown == i).tolist():
                image = Image.fromarray(frame).resize((width, height))
                sheet.paste(image, (cell % SHEET * width, cell // SHEET * height))
    finally:
        writer.close()
    return sheet
