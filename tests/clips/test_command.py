"""`python -m purerl.clips FILE`: lists, checks, cuts and draws."""

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("h5py", reason="pip install -e '.[clips]'")

from purerl import clips
from purerl.clips import __main__ as command
from purerl.envs import cartpole_swingup

BODY = ("--body", "cartpole_swingup")


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    model = cartpole_swingup.build().physics.model
    t = np.arange(51)[:, None] / 50.0
    tracks = [np.hstack([2.0 * t, 3.0 * t]), np.hstack([0 * t, t])[:21]]
    path = tmp_path_factory.mktemp("clips") / "motion.h5"
    clips.write(path, clips.pack(model, tracks, ("Roll_1", "Hang_2"), 50.0), model)
    return path


def test_clips_are_listed_without_a_body(file, capsys):
    assert command.main([str(file)]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "Roll_1: Roll, 1.00 s, 51 frames at 50 Hz",
        "Hang_2: Hang, 0.40 s, 21 frames at 50 Hz",
    ]
    assert command.main([str(file), "--draw", "Roll_1"]) == 2
    assert "need the body" in capsys.readouterr().err


def test_they_are_checked_cut_and_drawn_with_one(file, capsys, tmp_path, monkeypatch, opengl):
    monkeypatch.chdir(tmp_path)
    assert command.main([str(file), *BODY]) == 0
    first, _ = capsys.readouterr().out.splitlines()
    assert first.startswith("Roll_1: Roll, 1.00 s, 51 frames at 50 Hz; 0.00 m/s; ")
    words = ["--cut", "Roll_1", "0.2", "0.6", "-o", "part.h5", "--draw", "Hang_2"]
    assert command.main([str(file), *BODY, *words]) == 0
    assert command.main([str(file), *BODY, *words]) == 2, "part.h5 is there"
    part = clips.read("part.h5")
    assert part.names == ("Roll_1",) and part.lengths.tolist() == [21]
    np.testing.assert_allclose(part.values[0, :, 0], 2.0 * np.arange(10, 31) / 50, atol=1e-6)
    assert (tmp_path / "Hang_2.mp4").stat().st_size > 1000
    sheet = np.asarray(Image.open("Hang_2.png"))
    assert (sheet[:240, :320] != sheet[-240:, -320:]).any(), "the pole turns"


def test_a_file_without_a_rate_is_written_with_it(capsys, tmp_path, monkeypatch):
    import h5py

    monkeypatch.chdir(tmp_path)
    with h5py.File("ours.h5", "w") as file:
        file["qpos"] = np.linspace(0, 1, 80).reshape(40, 2)
        file["names_qpos"] = np.array(["hinge", "slide"], "S")
    words = ["ours.h5", *BODY, "--frames", "20"]
    assert command.main(words) == 2
    assert "--rate 50 --body BODY -o NEW.h5` writes a file" in capsys.readouterr().err
    assert command.main([*words, "--rate", "100", "-o", "rated.h5"]) == 0
    (ours, rated) = clips.read("ours.h5", 100.0, 20), clips.read("rated.h5")
    assert rated.rate == 100.0 and rated.names == ours.names and len(rated.names) == 2
    order = [rated.columns.index(name) for name in ours.columns]
    np.testing.assert_allclose(rated.values[..., order], ours.values, atol=1e-6)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["none.h5"], "none.h5 cannot be read: No such file or directory (in /"),
        (["FILE", "--rate", "100"], "is of 50 Hz, not 100: leave the rate out."),
        (["FILE", *BODY, "--cut", "Roll_1", "0.5", "2"], "0.5 to 2 s is no part of it."),
        (["FILE", *BODY, "--cut", "Roll_1", "nan", "1"], "nan to 1 s is no part of it."),
        (["FILE", *BODY, "--cut", "Roll_1", "0", "inf"], "0 to inf s is no part of it."),
        (["FILE", *BODY, "--cut", "Rol_1", "0.5", "2"], "no clip 'Rol_1'. Did you mean 'Roll_1'"),
    ],
)
def test_a_mistake_is_one_line(file, capsys, words, says):
    assert command.main([str(file) if word == "FILE" else word for word in words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert says in line
