"""The window's parts that need no browser: numbers, words, pushes, shapes, ports."""

import contextlib
import dataclasses
import shlex
import socket
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from purerl import UserError
from purerl.envs import randomization, run
from purerl.experiment.command_line import from_command_line
from purerl.experiment.loading import find_source
from purerl.physics.drawing import Picture, Stage
from purerl.tune import overrides
from purerl.tune.option_numbers import bounds, label, numbers_of, replaced
from purerl.tune.view import loop, opening, push, shapes
from purerl.tune.view.page import Page

# --- numbers ---


def test_every_number_of_the_options_has_a_place():
    options = run.Options(gap_length=(0.1, 0.3))
    numbers = numbers_of(options)
    assert numbers["gap_length", 1] == 0.3 and numbers["randomization", "mass", 0] == 1.0
    assert ("observe_place",) not in numbers and ("body",) not in numbers  # no numbers
    assert ("least_height",) not in numbers  # None
    assert replaced(options, numbers) == options
    assert label(("randomization", "mass", 0)) == "randomization.mass[0]"


def test_a_rule_sees_all_numbers_that_change_together():
    options = randomization.Randomization(friction=(0.5, 0.9))
    changed = replaced(options, {("friction", 0): 1.5, ("friction", 1): 2.0})
    assert changed.friction == (1.5, 2.0)
    with pytest.raises(ValueError, match="friction"):
        replaced(options, {("friction", 0): 1.5})


@pytest.mark.parametrize("value", [5.0, 1.0, 0.05, 1e-5, 3.7e4, -2.0, 0.0, 5, 1, 0, -3, 4096])
def test_a_slider_reaches_from_nought_to_four_times_the_number(value):
    least, greatest, step = bounds(value)
    assert least <= 0 <= greatest and least <= value <= greatest
    assert max(-least, greatest) >= 4 * abs(value) * (1 - 1e-9)
    assert isinstance(step, type(value)) and 0 < step <= greatest - least
    if isinstance(value, float):
        assert 100 <= (greatest - least) / step <= 501
        assert max(-least, greatest) == pytest.approx(4 * abs(value) or 1.0)


# --- words ---


def test_the_shown_command_makes_the_setting():
    source = find_source("ant_gaps")
    env = dataclasses.replace(
        source.experiment.env, gap_length=(0.1, 0.35), observe_place=True, forward_weight=0.1 + 0.2,
        randomization=randomization.Randomization(mass=(0.5, 1.5)), least_height=0.2, substeps=4,
    )  # fmt: skip
    chosen = dataclasses.replace(
        source.experiment, ppo=dataclasses.replace(source.experiment.ppo, schedule="constant")
    )
    line = overrides.train_command("ant_gaps", source.experiment, chosen, env)
    assert line.startswith("python -m purerl.run ant_gaps --env.") and " 0.3 " in line
    made, _ = from_command_line(source, shlex.split(line)[4:], "x")
    assert made == dataclasses.replace(
        chosen, env=dataclasses.replace(env, forward_weight=0.3)
    )  # a slider's 0.30000000000000004
    assert overrides.option_words("env", source.experiment.env, source.experiment.env) == []


def test_a_flag_that_is_on_is_switched_off_by_its_no():
    assert overrides.option_words("env.walls", True, False) == ["--env.no-walls"]


# --- pushes ---


def model_of(xml: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{xml}</worldbody></mujoco>")


def test_a_pushed_point_takes_just_that_velocity():
    model = run.build(run.Options(), "c").physics.model
    data = push.place(model, model.qpos0, np.zeros(model.nv))
    body = model.body("walker/torso").id
    point = data.xpos[body] + [0.0, 0.0, 0.1]
    change = push.push(model, data, body, point, (0.5, -1.0, 0.25))
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, point, body)
    np.testing.assert_allclose(jacobian @ change, [0.5, -1.0, 0.25], atol=1e-9)
    # By one impulse at that point and nothing else: J' p, and no more work than that.
    momentum = np.zeros(model.nv)
    mujoco.mj_mulM(model, data, momentum, change)
    impulse = np.linalg.lstsq(jacobian.T, momentum, rcond=None)[0]
    np.testing.assert_allclose(jacobian.T @ impulse, momentum, atol=1e-8)


def test_a_cart_takes_what_its_rail_allows():
    model = model_of('<body><joint type="slide" axis="1 0 0"/><geom size="0.1"/></body>')
    data = push.place(model, [0.0], [0.0])
    np.testing.assert_allclose(push.push(model, data, 1, (0, 0, 0), (2, 5, 5)), [2.0])
    np.testing.assert_allclose(push.push(model, data, 1, (0, 0, 0), (0, 1, 0)), [0.0], atol=1e-12)


def test_a_pull_draws_the_grip_to_the_pointer_and_settles():
    model = model_of('<body><freejoint/><geom type="box" size="0.3 0.2 0.1"/></body>')
    model.opt.gravity[:] = 0
    data = push.place(model, model.qpos0, np.zeros(6))
    held = push.grip(data, 1, start=(0.3, 0.0, 0.0), target=(0.3, 1.0, 0.5))
    far, steps = [], 200
    for _ in range(steps):
        now = push.place(model, data.qpos, data.qvel)
        point = now.xpos[1] + now.xmat[1].reshape(3, 3) @ held.point
        far.append(np.linalg.norm(point - held.target))
        data.qvel += push.pull(model, now, held, 0.02)
        for _ in range(10):
            mujoco.mj_step(model, data)
    assert far[0] > 1.1 and far[-1] < 0.05 and max(far) < 1.2


# --- shapes ---


@pytest.mark.parametrize(
    ("shape", "volume"),
    [(shapes.SPHERE, 4 / 3 * np.pi), (shapes.ROD, 2 * np.pi), (shapes.BOX, 8)],
)
def test_meshes_are_closed_and_seen_from_outside(shape, volume):
    mesh = shapes.UNIT_MESHES[shape]
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(float) for i in range(3))
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(volume, rel=0.05)
    assert np.abs(mesh.vertices).max() == pytest.approx(1.0)


def test_a_capsule_is_a_rod_between_two_spheres():
    capsule = '<geom type="capsule" size="0.1 0.5" euler="0 90 0" pos="0 0 1"/>'
    stage = Stage(model_of(f"<body><freejoint/>{capsule}</body>"))
    model, data = stage.model, stage.data
    stage.pose(Picture(model.qpos0, np.zeros((0, 3)), np.zeros((0, 4)), {}, ()))
    found = shapes.batches(model)
    assert set(found) == {"body/rod", "body/sphere"}
    balls = shapes.layout(model, data, found["body/sphere"])
    np.testing.assert_allclose(balls.scales, 0.1)
    np.testing.assert_allclose(sorted(balls.positions[:, 0]), [-0.5, 0.5], atol=1e-6)
    np.testing.assert_allclose(balls.positions[:, 2], 1.0, atol=1e-6)
    rod = shapes.layout(model, data, found["body/rod"])
    np.testing.assert_allclose(rod.scales, [[0.1, 0.1, 0.5]])


def test_an_episodes_own_boxes_are_where_its_physics_has_them():
    stage = Stage(run.build(run.Options(arena="gaps"), "c").physics.model)
    model, data, found = stage.model, stage.data, shapes.batches(stage.model)["ground/box"]
    drawn = []
    for x, half in ((7.0, 0.9), (9.0, 0.4)):
        position, size = model.geom_pos.copy(), model.geom_size.copy()
        position[found.geoms[1], 0], size[found.geoms[1], 0] = x, half
        changes = {"geom_pos": position, "geom_size": size}
        stage.pose(Picture(model.qpos0, np.zeros((0, 3)), np.zeros((0, 4)), changes, ()))
        drawn.append(shapes.layout(model, data, found))
    assert [float(each.positions[1, 0]) for each in drawn] == [7.0, 9.0]
    assert [float(each.scales[1, 0]) for each in drawn] == [np.float32(0.9), np.float32(0.4)]


def test_a_ghost_is_where_it_ought_to_be_and_cannot_be_drawn_at():
    floor = '<geom type="box" size="1 1 0.1"/>'
    stage = Stage(model_of(f'{floor}<body><freejoint/><geom size="0.1"/></body>'))
    where = stage.model.qpos0 + np.array([2.0, 0, 0, 0, 0, 0, 0])
    still = np.zeros((0, 3)), np.zeros((0, 4)), {}, (), ()
    stage.pose(Picture(stage.model.qpos0, *still, (where,)))
    body = shapes.batches(stage.model)
    found = shapes.ghosts(body)
    assert set(body) == {"ground/box", "body/sphere"} and set(found) == {"ghost/body/sphere"}
    ghost = found["ghost/body/sphere"]
    assert not ghost.moving and (ghost.opacities < 0.5).all()
    assert shapes.layout(stage.model, stage.ghost, ghost).positions[0, 0] == 2.0
    assert shapes.layout(stage.model, stage.data, body["body/sphere"]).positions[0, 0] == 0.0


def test_a_mesh_and_a_hidden_geom():
    xml = """<mujoco><asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset><worldbody>
      <geom type="mesh" mesh="m"/><geom size="1" group="4"/><geom size="1" rgba="0 0 0 0"/>
      <geom type="plane" size="1 1 1"/></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    assert {name: len(batch.geoms) for name, batch in shapes.batches(model).items()} == {
        "ground/mesh0": 1
    }
    assert shapes.planes(model) == [3]


# --- where it listens, what it needs ---


def test_a_port_in_use_is_one_line():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(UserError, match=f"127.0.0.1:{port} cannot be listened on.*--port"):
            loop.check_port("127.0.0.1", port)
    loop.check_port("127.0.0.1", 0)
    with pytest.raises(UserError, match="nowhere.invalid:1"):
        loop.check_port("nowhere.invalid", 1)
    with pytest.raises(
        UserError, match="203.0.113.1:1 cannot .* an address of this machine as --host"
    ):
        loop.check_port("203.0.113.1", 1)
    with pytest.raises(UserError, match="127.0.0.1:99999 cannot be listened on .*0 to 65535"):
        loop.check_port("127.0.0.1", 99999)


def test_checkpoints_of_a_folder_that_is_gone(tmp_path):
    assert opening.checkpoint_names(tmp_path / "no", "best") == ["best", "latest"]
    (tmp_path / "checkpoints" / "000000000007").mkdir(parents=True)
    (tmp_path / "checkpoints" / "000000000012").mkdir()
    names = opening.checkpoint_names(tmp_path, "latest")
    assert names == ["latest", "best", "12", "7"]


def test_what_the_eyes_see_is_shown_and_moves_on():
    """Without a server: a page adds one picture, and changes it with each state."""
    shown = []

    def add_image(image, label):
        shown.append(SimpleNamespace(image=image, label=label))
        return shown[-1]

    own = Page.__new__(Page)
    own.eyes, own.tab = None, contextlib.nullcontext()
    own.server = SimpleNamespace(gui=SimpleNamespace(add_image=add_image))
    seen = np.arange(32, dtype=np.uint8).reshape(2, 4, 4)  # two eyes of 4 x 4
    for eyes in ((), (seen,), (seen + 100,)):
        picture = Picture(np.zeros(1), np.zeros((0, 3)), np.zeros((0, 4)), {}, (), eyes)
        own._draw_eyes(SimpleNamespace(picture=picture))
    assert len(shown) == 1
    image = shown[0].image
    assert image.shape == (160, 320, 3) and image[0, 160, 0] == seen[1, 0, 0] + 100
