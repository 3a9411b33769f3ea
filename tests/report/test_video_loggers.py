"""Videos reach TensorBoard and W&B: read back from the files that they write."""

import io
import json
import struct
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from purerl import run
from purerl.experiment.options import RunOptions
from purerl.report.video import _write_video
from purerl.report.video_loggers import as_gif, log_video
from tests.report.test_render import TINY

SIZE = (64, 48)
COLORS = [(255, 0, 0), (0, 255, 0), (0, 0, 255)]


@pytest.fixture
def video(tmp_path):
    """A run's folder with 1.5 s of video at 50 frames a second: red, green, blue."""
    (tmp_path / "videos").mkdir()
    path = tmp_path / "videos" / "000000000007.mp4"
    writer = imageio_ffmpeg.write_frames(str(path), SIZE, fps=50, macro_block_size=2)
    writer.send(None)
    for color in COLORS:
        for _ in range(25):
            writer.send(np.full((SIZE[1], SIZE[0], 3), color, np.uint8))
    writer.close()
    Image.new("RGB", (80, 60), (9, 9, 9)).save(path.with_suffix(".png"))
    (tmp_path / "manifest.json").write_text(json.dumps({"run_id": "0123456789ab"}))
    (tmp_path / "config.json").write_text(json.dumps({"settings": {}}))
    return path


def frames(content: bytes) -> tuple[list[np.ndarray], float]:
    """Returns a GIF's frames, [H, W, 3] each, and how long it takes [s]."""
    with Image.open(io.BytesIO(content)) as picture:
        found, seconds = [], 0.0
        for number in range(picture.n_frames):
            picture.seek(number)
            seconds += picture.info["duration"] / 1000
            found.append(np.asarray(picture.convert("RGB"), int))
    return found, seconds


def images(folder) -> dict:
    """Returns the images of TensorBoard's files, name -> (step, image), as TensorBoard reads."""
    from tensorboardX.proto.event_pb2 import Event

    found = {}
    for file in sorted((folder / "tensorboard").iterdir()):
        content = file.read_bytes()
        while content:
            (length,) = struct.unpack("<Q", content[:8])
            event = Event.FromString(content[12 : 12 + length])  # each length and record has a CRC
            content = content[16 + length :]
            for value in event.summary.value:
                if value.HasField("image"):
                    found[value.tag] = (event.step, value.image)
    return found


def test_a_gif_shows_the_video_in_its_own_time(video):
    content, size = as_gif(video)
    shown, seconds = frames(content)
    assert size == (320, 240) and shown[0].shape == (240, 320, 3)
    assert seconds == pytest.approx(1.5)
    for frame, color in zip((shown[0], shown[len(shown) // 2], shown[-1]), COLORS, strict=True):
        assert np.abs(frame.mean((0, 1)) - color).max() < 60


@pytest.mark.parametrize("name", ["a:b%03d.mp4", "http:x.mp4", "-y.mp4", "a[1].mp4"])
def test_a_video_is_written_and_read_whatever_its_name(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    black = (np.zeros((*SIZE[::-1], 3), np.uint8) for _ in range(3))
    _write_video(Path(name), black, 3, SIZE, 10.0)
    assert [file.name for file in tmp_path.iterdir()] == [name] and as_gif(Path(name))


def test_tensorboard_has_the_video_and_its_sheet(video):
    pytest.importorskip("tensorboardX")
    assert len(log_video(RunOptions(tensorboard=True), video.parents[1], video, 7)) == 1
    found = images(video.parents[1])
    assert {name: step for name, (step, _) in found.items()} == {"video": 7, "contact_sheet": 7}
    assert len(frames(found["video"][1].encoded_image_string)[0]) >= 3
    sheet = found["contact_sheet"][1]
    assert (sheet.width, sheet.height) == (80, 60)
    assert sheet.encoded_image_string == video.with_suffix(".png").read_bytes()


def test_without_loggers_nothing_is_written(video):
    before = sorted(video.parents[1].rglob("*"))
    assert log_video(RunOptions(), video.parents[1], video, 7) == []
    assert sorted(video.parents[1].rglob("*")) == before


@pytest.mark.slow
def test_wandb_has_the_video_and_its_sheet(video):
    pytest.importorskip("wandb")
    log_video(RunOptions(wandb="offline"), video.parents[1], video, 7)
    (files,) = video.parents[1].glob("wandb/offline-run-*-0123456789ab/files/media")
    (mp4,) = files.rglob("*.mp4")
    assert mp4.read_bytes() == video.read_bytes()
    assert len(list(files.rglob("*.png"))) == 1


@pytest.mark.slow
@pytest.mark.usefixtures("opengl")
def test_the_command_logs_what_it_draws(tmp_path, capsys):
    words = ["cartpole_swingup", "--runs", str(tmp_path), *TINY.split()]
    assert run.main([*words, "--video", "--tensorboard"]) == 0
    said = capsys.readouterr()
    assert "TensorBoard has it as the images video and contact_sheet" in said.out, said.err
    found = images(tmp_path / "cartpole_swingup" / "seed1")
    assert found["video"][0] == found["contact_sheet"][0] == 3
