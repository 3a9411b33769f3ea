"""`python -m purerl.render RUN`, and `--video` of a run. Tests that draw need OpenGL."""

import dataclasses
import json
import re
import shutil
import sys
import types
from pathlib import Path

import imageio_ffmpeg
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from PIL import Image

import purerl
from purerl import render, run
from purerl.core.errors import FAILURE, USAGE, RunError, UserError
from purerl.core.keys import per_environment
from purerl.envs import cartpole_swingup
from purerl.physics.drawing import default_camera, find_camera, root_body
from purerl.report import episode_pictures, opengl, renderer as drawing, video
from purerl.runs.policy import Policy
from purerl.runs.restored_run import restore
from tests import quick

pytestmark = pytest.mark.usefixtures("file_is_compiled_quickly")

TINY = "--ppo.num-envs 4 --ppo.rollout-length 8 --ppo.num-steps 96 --ppo.num-minibatches 2"
TINY += " --ppo.episode-length 60 --evaluation.num-episodes 2 --evaluation.number 1"


def train(place: Path, name: str, *words: str) -> Path:
    arguments = ["cartpole_swingup", "--runs", str(place), "--name", name, *TINY.split(), *words]
    assert run.main(arguments) == 0
    return place / "cartpole_swingup" / name


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("render")


@pytest.fixture(scope="module")
def trained(place) -> Path:
    return train(place, "plain")


def read_video(path: Path) -> tuple[dict, np.ndarray]:
    reader = imageio_ffmpeg.read_frames(str(path))
    about = next(reader)
    width, height = about["size"]
    frames = [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]
    return about, np.stack(frames)


def only_line(capsys) -> str:
    said = capsys.readouterr().err.strip()
    assert len(said.splitlines()) == 1 and "Traceback" not in said
    return said


# --- files ---


@pytest.mark.slow
@pytest.mark.usefixtures("opengl")
def test_video_and_sheet_show_the_episode_in_real_time(trained, capsys):
    words = ["--size", "160x120", "--seconds", "0.8", "--episodes", "2"]
    assert render.main([str(trained), *words]) == 0
    name = "000000000003_episodes-2_seconds-0.8_size-160x120"
    about, frames = read_video(trained / "videos" / f"{name}.mp4")
    assert about["size"] == (160, 120) and about["fps"] == 50.0
    assert len(frames) == 2 * (1 + 40)  # 0.8 s of 20 ms, and the start, twice
    assert np.abs(frames[0].astype(int) - frames[40]).max() > 60  # the pole has moved
    assert np.abs(frames[0].astype(int) - frames[41]).mean() < 3  # and hangs again
    with Image.open(trained / "videos" / f"{name}.png") as sheet:
        assert sheet.size == (4 * 320, 4 * 240)
        cells = np.asarray(sheet, int)
    for cell, moment in ((0, 0), (7, 38), (15, 81)):  # evenly spaced over 82 frames
        y, x = cell // 4 * 240, cell % 4 * 320
        frame = np.asarray(Image.fromarray(frames[moment]).resize((320, 240)), int)
        assert np.abs(cells[y : y + 240, x : x + 320] - frame).mean() < 3
    said = capsys.readouterr().out
    assert said.startswith("Compiling and playing: ")
    assert "update 3, episode 2: 0.8 s (cut there)" in said
    files = [line.rpartition("/")[2] for line in said.splitlines()[-2:]]
    assert files == [f"{name}.png", f"{name}.mp4"]
    assert "no episode above came to its end" in said


@pytest.mark.usefixtures("opengl")
def test_what_is_not_the_default_stands_in_the_name(trained, capsys):
    words = ["--size", "64x48", "--seed", "3", "--camera", "front"]
    assert render.main([str(trained), *words]) == 0
    _, frames = read_video(trained / "videos" / "000000000003_camera-front_seed-3_size-64x48.mp4")
    assert len(frames) == 61  # the whole episode
    said = capsys.readouterr().out
    assert "1.2 s (to its end)" in said
    assert re.search(r"evaluation after update 3: return .* in that range: [01] of 1", said)


@pytest.mark.slow
@pytest.mark.usefixtures("opengl")
def test_another_environment_and_a_lesion_are_shown_and_named(trained, capsys):
    """6 s."""
    said = []
    lesion = ["--lesion.layer", "policy/Dense_0", "--lesion.kind", "clamp", "--lesion.strength=9"]
    for words in ([], ["--env.reset-noise", "1.5"], ["--env.reset-noise", "1.5", *lesion]):
        assert render.main([str(trained), "--size", "32x32", *words]) == 0
        said.append(capsys.readouterr().out)
    returns = [re.search(r"return (\S+)", text)[1] for text in said]
    assert len(set(returns)) == 3
    assert ["evaluation after" in text for text in said] == [True, False, False]
    videos = trained / "videos"
    start, acting = (
        "000000000003_env.reset_noise-1.5",
        "lesion.kind-clamp_lesion.layer-policy-Dense_0",
    )
    one = read_video(videos / f"{start}_size-32x32.mp4")[1]
    two = read_video(videos / f"{start}_{acting}_lesion.strength-9.0_size-32x32.mp4")[1]
    assert (one[0] == two[0]).all() and (one[-1] != two[-1]).any()  # from the same start


@pytest.mark.parametrize("name", ["a:b%03d.mp4", "http:x.mp4", "-y.mp4", "a[1].mp4"])
def test_a_video_is_written_whatever_its_name(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    black = (np.zeros((48, 64, 3), np.uint8) for _ in range(3))
    video._write_video(Path(name), black, 3, (64, 48), 10.0)
    assert [file.name for file in tmp_path.iterdir()] == [name]
    assert len(read_video(tmp_path / name)[1]) == 3


@pytest.mark.slow
@pytest.mark.usefixtures("opengl")
def test_the_command_hands_its_video_to_wandb(tmp_path, capsys):
    pytest.importorskip("wandb")
    words = ["cartpole_swingup", "--runs", str(tmp_path), *TINY.split()]
    assert run.main([*words, "--video", "--wandb", "offline"]) == 0
    said, place = capsys.readouterr(), tmp_path / "cartpole_swingup" / "seed1"
    assert "W&B has it as video and contact_sheet" in said.out, said.err
    found = [file for file in place.glob("wandb/offline-run-*/files/media/**/*") if file.is_file()]
    for kind in ("mp4", "png"):
        (own,) = place.glob(f"videos/*.{kind}")
        assert [file.read_bytes() for file in found if file.suffix == own.suffix] == [
            own.read_bytes()
        ]


@pytest.mark.usefixtures("opengl")
def test_frames_are_had_in_one_call_from_a_camera_by_name_or_number(trained):
    loaded = purerl.load(trained)
    model = loaded.env.physics.model
    number = model.camera("front").id
    images, rate = purerl.frames(loaded, number, seconds=0.2, size=(64, 48))
    assert images.shape == (11, 48, 64, 3) and images.dtype == np.uint8 and rate == 50.0
    assert np.abs(images[0].astype(int) - images[-1]).max() > 30  # the pole has moved
    assert find_camera(model, "front") == find_camera(model, str(number)) == number
    for wrong in ({"size": (0, 48)}, {"seconds": 0.0}, {"camera": model.ncam}, {"seed": -1}):
        with pytest.raises(UserError, match=next(iter(wrong))):
            purerl.frames(loaded, **wrong)


def test_returns_are_held_against_the_evaluation_before_the_checkpoint():
    about = {"eval/episode_return_std": 1.0, "eval/episode_return_min": 4.0}
    about |= {"eval/episode_return": 5.0, "eval/episode_return_max": 7.0}
    lines = [{"update": 2} | about, {"update": 3, "train/loss": 1.0}]
    lines.append({"update": 4} | {name: 100.0 for name in about})
    (said,) = video.beside_evaluation(lines, 3, [3.9, 4.0, 7.0, 7.1])
    assert "after update 2: return 5.00 +- 1.00, from 4.00 to 7.00; " in said
    assert said.endswith("in that range: 2 of 4")
    assert video.beside_evaluation(lines[1:], 3, [5.0]) == []
    assert video.beside_evaluation([{"update": 1, "eval/episode_return": 5.0}], 3, [5.0]) == []


# --- the episode ---


def test_states_are_those_of_the_policy(trained):
    found = restore(trained, "latest", print)
    config = dataclasses.replace(found.setup.config, episode_length=7)
    setup, state, key = found.setup._replace(config=config), found.saved.state, jax.random.key(5)
    recording = quick.jit(lambda s: episode_pictures.record(setup, s, key, 2, 9))(state)
    assert recording.shown.shape == (10, 2)  # the start, and 9 steps
    assert recording.shown.sum(0).tolist() == [8, 8] and recording.over.all()
    assert recording.length.tolist() == [7, 7]

    policy, step = Policy(setup.env, setup.network, state), quick.jit(setup.env.step)
    expected = setup.env.reset(per_environment(key, jnp.arange(2))[1])
    total = 0.0
    for t in range(7):
        assert np.allclose(recording.pictures.qpos[t, 1], expected.physics.qpos, atol=1e-5)
        expected = step(expected, policy(expected.observation))
        total += float(expected.reward)
    assert np.allclose(recording.pictures.qpos[7, 1], expected.physics.qpos, atol=1e-5)
    assert float(recording.episode_return[1]) == pytest.approx(total, abs=1e-4)


@dataclasses.dataclass(frozen=True)
class Stretched:
    """A cart-pole whose cart is of another size in every episode."""

    inner: cartpole_swingup.CartpoleSwingup
    action_size = 1
    control_timestep = 0.02

    @property
    def physics(self):
        return self.inner.physics

    def reset(self, key):
        inner, own = jax.random.split(key)
        state = self.inner.reset(inner)
        return state.replace(task=jax.random.uniform(own, (), minval=0.1, maxval=0.5))

    def step(self, state, action):
        return self.inner.step(state.replace(task=()), action).replace(task=state.task)

    def model_changes(self, state):
        size = jnp.asarray(self.physics.model.geom_size, jnp.float32)
        return {"geom_size": size.at[1, 0].set(state.task)}

    def scenery(self, state):
        return jnp.full((1, 3), state.task), jnp.ones((1, 3))


def test_each_episode_keeps_the_geometry_it_had(trained):
    found = restore(trained, "latest", print)
    setup = found.setup._replace(env=Stretched(found.setup.env))
    recording = quick.jit(lambda s: episode_pictures.record(setup, s, jax.random.key(0), 3, 4))(
        found.saved.state
    )
    widths = np.asarray(recording.pictures.changes["geom_size"])[:, :, 1, 0]
    assert widths.shape == (5, 3) and len(set(widths[0])) == 3
    assert (widths == widths[0]).all()
    assert recording.pictures.scenery[0].shape == (5, 3, 1, 3)
    last = episode_pictures.episode_pictures(jax.device_get(recording), 2, 3)
    assert len(last) == 3 and last[-1].changes["geom_size"][1, 0] == widths[0, 2]  # 0, 3 and 4


@pytest.mark.parametrize(
    "timestep, stride", [(0.1, 1), (0.02, 1), (0.015, 2), (0.01, 2), (0.005, 4), (0.0025, 8)]
)
def test_a_video_has_at_most_50_frames_a_second(timestep, stride):
    assert episode_pictures.frame_stride(timestep) == stride


# --- drawing ---

ROOM = """
<mujoco>
  <worldbody>
    <light pos="0 -3 3" dir="0 1 -1"/>
    {cameras}
    <geom name="ground" type="plane" size="5 5 1" rgba="0.2 0.6 0.2 1"/>
    <body name="ball" pos="0 0 1">
      {joint}
      <geom name="ball" size="0.2" rgba="1 0 0 1"/>
    </body>
  </worldbody>
</mujoco>
"""
TRACK = "<camera name='{}' mode='trackcom'/>"


def room(joint="<freejoint/>", cameras=""):
    return mujoco.MjModel.from_xml_string(ROOM.format(joint=joint, cameras=cameras))


def picture(model, qpos=None, changes=None, scenery=()):
    qpos = model.qpos0 if qpos is None else np.asarray(qpos, float)
    return episode_pictures.Picture(
        qpos, np.zeros((0, 3)), np.zeros((0, 4)), changes or {}, scenery
    )


def reddish(frame: np.ndarray) -> np.ndarray:
    return (frame[..., 0] > 60) & (frame[..., 1] < 0.5 * frame[..., 0].astype(float))


@pytest.mark.usefixtures("opengl")
def test_changed_geometry_shows():
    model = room()
    bigger = {"geom_size": np.array([[5, 5, 1], [0.4, 0, 0]])}
    # The ball coincides with its body, so the compiler told MuJoCo not to read this.
    moved = {"geom_pos": np.array([[0, 0, 0], [0.5, 0, 0]])}
    usual = {"geom_size": model.geom_size.copy(), "geom_pos": model.geom_pos.copy()}
    with drawing.Renderer(model, 160, 120) as renderer:
        plain = renderer.draw(picture(model))
        large = renderer.draw(picture(model, changes=usual | bigger))
        aside = renderer.draw(picture(model, changes=usual | moved))
        again = renderer.draw(picture(model, changes=usual))
    assert reddish(plain).sum() > 50
    assert reddish(large).sum() > 2.5 * reddish(plain).sum()
    columns = np.nonzero(reddish(aside))[1].mean() - np.nonzero(reddish(plain))[1].mean()
    assert columns > 20  # +x is to the right
    assert (again == plain).all()
    assert model.geom_size[1, 0] == 0.2  # the environment's own model is left alone


@pytest.mark.usefixtures("opengl")
def test_scenery_shows_and_is_forgotten():
    model = room()
    wall = (np.array([[0.0, -0.5, 1.0]]), np.array([[0.3, 0.05, 0.3]]))
    with drawing.Renderer(model, 160, 120) as renderer:
        plain = renderer.draw(picture(model))
        hidden = renderer.draw(picture(model, scenery=wall))
        assert (renderer.draw(picture(model)) == plain).all()
    assert reddish(hidden).sum() == 0


@pytest.mark.usefixtures("opengl")
def test_a_ghost_shows_beside_the_body_and_one_sees_through_it():
    model, where = room(), np.array([0.8, 0, 1, 1, 0, 0, 0], float)
    with drawing.Renderer(model, 160, 120) as renderer:
        plain = renderer.draw(picture(model))
        haunted = renderer.draw(picture(model)._replace(ghost=(where,)))
        near = np.array([0, -0.15, 1, 1, 0, 0, 0])
        before = renderer.draw(picture(model)._replace(ghost=(near,)))
        assert (renderer.draw(picture(model)) == plain).all()
    changed = (haunted != plain).any(-1)
    assert changed.sum() > 50 and np.nonzero(changed)[1].min() > 85  # to the right of the body
    assert (haunted[reddish(plain)] == plain[reddish(plain)]).mean() > 0.9
    bluer = before[..., 2].astype(int) - plain[..., 2]
    assert bluer[reddish(plain)].mean() > 10 and before[reddish(plain)][:, 0].mean() > 60


def test_furniture_is_not_what_the_camera_follows():
    shelf = "<body name='shelf'><geom size='1'/><body><geom size='1'/></body></body>"
    robot = "<body name='robot'><freejoint/><geom size='.1'/></body>"
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{shelf}{robot}</worldbody></mujoco>"
    )
    assert model.body(root_body(model)).name == "robot"


@pytest.mark.usefixtures("opengl")
def test_the_camera_follows_a_free_body_along_the_ground():
    model = room()
    start = [0, 0, 1, 1, 0, 0, 0]
    with drawing.Renderer(model, 160, 120) as renderer:
        near = reddish(renderer.draw(picture(model, start)))
        far = reddish(renderer.draw(picture(model, [3, 2, 1, 1, 0, 0, 0])))
        risen = reddish(renderer.draw(picture(model, [3, 2, 1.3, 1, 0, 0, 0])))
    middle = [np.argwhere(mask).mean(0) for mask in (near, far, risen)]
    assert np.abs(middle[0] - [60, 80]).max() < 3
    assert np.abs(middle[1] - middle[0]).max() < 2
    assert middle[2][0] < middle[0][0] - 10  # up in the picture, which is not upside down


@pytest.mark.parametrize(
    "joint, cameras, expected",
    [
        ("<freejoint/>", "<camera name='still'/>", None),
        ("<joint type='slide'/>", "<camera name='still'/>", "still"),
        ("<joint type='slide'/>", "", None),
        ("<freejoint/><camera name='eye'/>" + TRACK.format("back"), "<camera name='s'/>", "back"),
        ("<freejoint/>" + TRACK.format("back") + TRACK.format("side"), "", "side"),
        ("<joint type='hinge'/>" + TRACK.format("hand"), "<camera name='still'/>", "still"),
    ],
)
def test_the_default_camera_is_the_one_that_follows(joint, cameras, expected):
    model = room(joint, cameras)
    chosen = default_camera(model)
    assert (None if chosen is None else model.camera(chosen).name) == expected


# --- mistakes ---


@pytest.mark.usefixtures("opengl")
def test_an_unknown_camera_or_checkpoint_lists_those_there_are(trained, capsys):
    assert render.main([str(trained), "--camera", "frot"]) == USAGE
    said = only_line(capsys)
    assert "'frot'" in said and "Did you mean 'front'?" in said
    assert render.main([str(trained), "--checkpoint", "77"]) == USAGE
    assert "Valid: latest, best, 1, 2, 3" in only_line(capsys)


@pytest.mark.parametrize(
    "words, part",
    [
        (["--size", "large"], "such as 640x480"),
        (["--size", "161x120"], "even"),
        (["--size", "0x0"], "16"),
        (["--episodes", "0"], "at least 1"),
        (["--seconds", "nan"], "at least 0.1"),
        (["--sise", "64x64"], "--size"),
    ],
)
def test_a_wrong_option_is_one_line(trained, words, part, capsys):
    assert render.main([str(trained), *words]) == USAGE
    assert part in only_line(capsys)


@pytest.mark.usefixtures("opengl")
def test_no_run_and_no_physics_are_one_line(tmp_path, capsys):
    assert render.main([str(tmp_path)]) == USAGE
    assert "no config.json" in only_line(capsys)
    toy = Path(__file__).parent.parent / "runs" / "toy_experiment.py"
    assert run.main([str(toy), "--runs", str(tmp_path)]) == 0
    capsys.readouterr()
    assert render.main([str(tmp_path / "toy_experiment" / "seed1")]) == USAGE
    assert "cannot be drawn" in only_line(capsys)


@pytest.mark.usefixtures("opengl")
def test_settings_of_another_version_are_named(trained, tmp_path, capsys):
    copy = tmp_path / "run"
    shutil.copytree(trained, copy)
    settings = json.loads((copy / "config.json").read_text())
    settings["settings"]["env"]["gravity"] = 9.81
    (copy / "config.json").write_text(json.dumps(settings))
    assert render.main([str(copy)]) == USAGE
    assert "env.gravity" in only_line(capsys)


def test_without_opengl_one_line_says_what_to_install(trained, monkeypatch, capsys):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    assert render.main([str(trained)]) == FAILURE
    assert "MUJOCO_GL" in only_line(capsys)
    monkeypatch.delenv("MUJOCO_GL")
    with pytest.raises(RunError, match="apt-get install libosmesa6"):
        opengl.choose_gl(find=lambda name: None)


def test_a_backend_that_does_not_start_says_what_to_install(monkeypatch):
    class Broken:
        def __init__(self, *_):
            raise ImportError("no driver")

    # In place of the module, whose import fails where another backend is in use.
    monkeypatch.setitem(sys.modules, "mujoco.osmesa", types.SimpleNamespace(GLContext=Broken))
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setenv("PYOPENGL_PLATFORM", "osmesa")
    with pytest.raises(RunError, match="osmesa .ImportError.*apt-get install libosmesa6"):
        opengl.open_gl(64, 48)


@pytest.mark.usefixtures("opengl")
def test_files_that_cannot_be_written_are_one_line(trained, tmp_path, capsys):
    copy = tmp_path / "run"
    shutil.copytree(trained, copy, ignore=shutil.ignore_patterns("videos"))
    (copy / "videos").touch()
    words = ["--size", "64x48", "--seconds", "0.1"]
    assert render.main([str(copy), *words]) == FAILURE
    assert "cannot be written" in only_line(capsys)
    (copy / "videos").unlink()
    assert render.main([str(copy), *words]) == 0
    assert len(list((copy / "videos").iterdir())) == 2  # no draft is left


# --- with the run command ---


@pytest.mark.usefixtures("opengl")
def test_a_run_makes_a_video_and_learns_the_same(trained, place, capsys):
    folder = train(place, "with-video", "--video")
    assert capsys.readouterr().out.splitlines()[-1].endswith("000000000003.mp4")
    _, frames = read_video(folder / "videos" / "000000000003.mp4")
    assert len(frames) == 61

    def lines(path):
        read = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
        return [{k: v for k, v in line.items() if k != "wall_s"} for line in read]

    assert lines(folder) == lines(trained)
    assert "digest" in lines(folder)[-1]


def test_a_video_that_cannot_be_made_changes_nothing(trained, place, monkeypatch, capsys):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    folder = train(place, "without-opengl", "--video")  # with exit code 0
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1  # before training, and not again after it
    assert all("There is no video: MUJOCO_GL is 'disable'" in line for line in said)
    assert not (folder / "videos").exists()
    saved = [path / "checkpoints" / "000000000003" for path in (folder, trained)]
    digests = [json.loads((path / "meta.json").read_text())["digest"] for path in saved]
    assert digests[0] == digests[1]


def test_scenery_is_drawn_whatever_was_in_memory():
    """MuJoCo's `mjv_initGeom` leaves some fields as they are; a box with garbage was not drawn."""
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    scene = mujoco.MjvScene(model, 10)
    scene.geoms[0].category = scene.geoms[0].transparent = 77
    drawing.add_scenery(scene, (np.zeros((1, 3)), np.ones((1, 3))))
    assert scene.ngeom == 1 and scene.geoms[0].transparent == 0
    assert scene.geoms[0].category == mujoco.mjtCatBit.mjCAT_DECOR
