"""Videos for TensorBoard and Weights & Biases, which show what `run --video` made."""

import io
from pathlib import Path

from PIL import Image

from purerl.experiment.options import RunOptions
from purerl.runs.folder import read
from purerl.training.loggers import WandbSink

GIF_WIDTH = 320  # [pixels]; TensorBoard shows images alone, of which a GIF moves
GIF_RATE = 10.0  # frames a second
VIDEO, SHEET = "video", "contact_sheet"  # the names they have there


def log_video(options: RunOptions, folder: Path, video: Path, update: int) -> list[str]:
    """Hands a video and its contact sheet to the loggers that the run has.

    Args:
      options: of the run; they say which loggers.
      folder: the run.
      video: the mp4; the sheet is the PNG beside it.
      update: of the policy that it shows.

    Returns:
      A line for each logger.
    """
    lines = []
    if options.tensorboard:
        log_to_tensorboard(folder, video, update)
        lines.append(f"TensorBoard has it as the images {VIDEO} and {SHEET}")
    if options.wandb != "off":
        log_to_wandb(folder, options.wandb, options.wandb_project, video, update)
        lines.append(f"W&B has it as {VIDEO} and {SHEET}")
    return lines


def log_to_tensorboard(folder: Path, video: Path, update: int) -> None:
    """Writes a video, as a GIF, and its contact sheet into a file of their own for TensorBoard."""
    from tensorboardX import FileWriter
    from tensorboardX.proto.summary_pb2 import Summary

    found = [(VIDEO, *as_gif(video))]
    sheet = video.with_suffix(".png")
    with Image.open(sheet) as picture:
        found.append((SHEET, sheet.read_bytes(), picture.size))
    values = []
    for name, data, (width, height) in found:
        image = Summary.Image(width=width, height=height, colorspace=3, encoded_image_string=data)
        values.append(Summary.Value(tag=name, image=image))
    # The writer of the metrics, closed by now, may have a file of the same second.
    writer = FileWriter(str(folder / "tensorboard"), filename_suffix=".video")
    writer.add_summary(Summary(value=values), update)
    writer.close()


def as_gif(video: Path) -> tuple[bytes, tuple[int, int]]:
    """Returns a video as a GIF of the same duration, and its width and height [pixels]."""
    import imageio_ffmpeg

    reader = imageio_ffmpeg.read_frames(str(video.absolute()))
    about = next(reader)
    width, height = about["size"]
    size = GIF_WIDTH, round(GIF_WIDTH * height / width)
    stride = max(1, round(about["fps"] / GIF_RATE))
    kept = (frame for i, frame in enumerate(reader) if i % stride == 0)
    frames = [Image.frombytes("RGB", (width, height), frame).resize(size) for frame in kept]
    content = io.BytesIO()
    ms = round(1000 * stride / about["fps"])
    frames[0].save(content, "GIF", save_all=True, append_images=frames[1:], duration=ms, loop=0)
    return content.getvalue(), size


def log_to_wandb(folder: Path, mode: str, project: str, video: Path, update: int) -> None:
    """Goes on with the run at Weights & Biases, and logs a video and its contact sheet."""
    import wandb

    sink = WandbSink(read(folder), mode, project)
    shown = {
        VIDEO: wandb.Video(str(video), format="mp4"),
        SHEET: wandb.Image(str(video.with_suffix(".png"))),
    }
    sink.run.log(shown | {"update": update}, step=max(update, sink.run.step))
    sink.close()
