"""What eyes see is what stands there: against MuJoCo's own rays, kind by kind."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from purerl import eyes
from purerl.eyes import shapes
from purerl.eyes.eyes import ABYSS, CONTRAST, SHADE, SKY
from tests import quick

KINDS = {
    "plane": '<geom type="plane" size="0 0 1" pos="0 0 -.4" euler="5 3 0"/>',
    "tile": '<geom type="plane" size=".3 .2 1" pos=".1 0 0" euler="5 3 40"/>',
    "strip": '<geom type="plane" size="0 .2 1" euler="5 3 40"/>',
    "sphere": '<geom type="sphere" size=".3" pos=".1 .1 0"/>',
    "ellipsoid": '<geom type="ellipsoid" size=".1 .3 .2" euler="20 30 40"/>',
    "capsule": '<geom type="capsule" size=".15 .3" euler="20 60 40"/>',
    "cylinder": '<geom type="cylinder" size=".25 .2" euler="20 60 40"/>',
    "box": '<geom type="box" size=".3 .1 .2" euler="20 30 40"/>',
    "field": '<geom name="hill" type="hfield" hfield="hills" euler="20 10 40"/>',
}
HILLS = np.random.default_rng(1).uniform(size=(5, 7))  # as it is in a model: 0 to 1
HILLS = (HILLS - HILLS.min()) / np.ptp(HILLS)
EPISODE = np.random.default_rng(2).uniform(size=(5, 7)).astype(np.float32)
EYE = eyes.Eye("head", fovy=60.0)


def model_of(*geoms: str, head: str = "") -> mujoco.MjModel:
    """Geoms around the origin, and a head without weight of its own that can be anywhere."""
    return mujoco.MjModel.from_xml_string(
        '<mujoco><compiler angle="degree"/><asset><hfield name="hills" nrow="5" ncol="7" '
        f'size=".4 .3 .25 .1" elevation="{" ".join(map(str, HILLS[::-1].ravel()))}"/></asset>'
        '<worldbody><body mocap="true"><geom type="sphere" size="1e-3" rgba="0 0 0 0"/>'
        f"{''.join(geoms)}</body>"
        f'<body name="head" mocap="true">{head}'
        '<camera name="own" pos="0 0 .1" xyaxes="0 -1 0 0 0 1" fovy="70"/>'
        '<camera name="after" mode="track"/></body>'
        "</worldbody></mujoco>"
    )


def places(model: mujoco.MjModel, position, toward, turn: float = 0.0):
    """MuJoCo's data, and xpos and xmat, for a head that looks from one point toward another."""
    data = mujoco.MjData(model)
    x = np.subtract(toward, position) / np.linalg.norm(np.subtract(toward, position))
    y = np.cross([0.0, np.sin(turn), np.cos(turn)], x)
    y /= np.linalg.norm(y)
    axes = np.stack([x, y, np.cross(x, y)], axis=1)
    data.mocap_pos[1] = position
    mujoco.mju_mat2Quat(data.mocap_quat[1], axes.ravel())
    mujoco.mj_forward(model, data)
    return data, jnp.float32(data.xpos), jnp.float32(data.xmat.reshape(-1, 3, 3))


def distance(sight: eyes.Eyes, *places, jit=jax.jit) -> np.ndarray:
    return np.asarray(jit(sight.distance)(*places))


def picture(sight: eyes.Eyes, *places, jit=jax.jit) -> np.ndarray:
    return np.asarray(jit(sight.see)(*places))


def rays_of_mujoco(model, data, eye: eyes.Eye, size: int) -> np.ndarray:
    """Distances [size, size] along rays, by `mj_ray`; inf where it meets nothing."""
    axes = data.body(eye.body).xmat.reshape(3, 3) @ eye.axes
    start = data.body(eye.body).xpos + data.body(eye.body).xmat.reshape(3, 3) @ eye.position
    half, found = np.tan(np.radians(eye.fovy / 2)), np.zeros((size, size))
    for row, column in np.ndindex(size, size):
        right, up = (2 * column + 1) / size - 1, 1 - (2 * row + 1) / size
        ray = axes @ [half * right, half * up, -1.0]
        groups, geom = np.array([1, 1, 1, 0, 0, 0], np.uint8), np.zeros(1, np.int32)
        ray /= np.linalg.norm(ray)
        found[row, column] = mujoco.mj_ray(model, data, start, ray, groups, 1, -1, geom)
    return np.where(found < 0, np.inf, found)


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_is_where_mujocos_rays_meet_it(kind):
    """1 s each. From eight sides, askew; four from afar, where b^2 - a c would cancel."""
    model, random, hits = model_of(KINDS[kind]), np.random.default_rng(0), 0
    for far, fovy in ((1.0, 60.0), (100.0, 0.6)):
        eye = dataclasses.replace(EYE)
        object.__setattr__(eye, "fovy", fovy)  # narrower than an eye may be
        distances = quick.jit(eyes.Eyes(model, [eye], (15, 15), reach=1e3).distance)
        for side in random.normal(size=(4, 3)):
            side[2] = abs(side[2])
            place, toward = far * side / np.linalg.norm(side), 0.1 * random.normal(size=3)
            data, xpos, xmat = places(model, place, toward, random.uniform(0, 1))
            found, right = distances(xpos, xmat)[0], rays_of_mujoco(model, data, eye, 15)
            both = np.isfinite(found) & np.isfinite(right)
            np.testing.assert_allclose(found[both], right[both], rtol=1e-4 if far < 10 else 3e-6)
            # On an outline rounding decides.
            assert (np.isfinite(found) != np.isfinite(right)).sum() <= 2
            hits += both.sum()
    assert hits > 150


def test_all_together_the_nearest_is_seen_and_what_is_behind_costs_nothing():
    """2 s. Shapes behind the eye, beside its view or out of reach change no bit."""
    shifts = {"ellipsoid": "0 .5 0", "box": ".5 0 .2", "capsule": "-.4 .2 .1"}
    moved = [
        g.replace("/>", f' pos="{shifts[k]}"/>' if k in shifts else "/>") for k, g in KINDS.items()
    ]
    model = model_of(*moved)
    sight = eyes.Eyes(model, [EYE], (24, 24), reach=5.0)
    data, xpos, xmat = places(model, [1.2, 0.3, 0.5], [0, 0, 0])
    found, right = distance(sight, xpos, xmat)[0], rays_of_mujoco(model, data, EYE, 24)
    both = np.isfinite(found) & np.isfinite(right)
    assert both.mean() > 0.5
    np.testing.assert_allclose(found[both], right[both], rtol=1e-4)
    away = (
        '<geom type="box" size=".2 .2 .2" pos="3 .5 1"/>',
        '<geom type="sphere" size=".1" pos="0 9 0"/>',
        '<geom type="capsule" size=".1 .1" pos="-6 -1 -2"/>',
    )
    more = eyes.Eyes(model_of(*moved, *away), [EYE], (24, 24), reach=5.0)
    both = [picture(one, xpos, xmat, jit=quick.jit) for one in (sight, more)]
    assert np.array_equal(*both)


def test_boxes_of_an_episode_are_seen_like_those_of_the_model():
    """1 s. To the bit where they are as grey."""
    still = '<geom type="box" size=".3 .1 .2" pos="0 .1 0" rgba=".5 .5 .5 1"/>'
    compiled = model_of(still).__copy__()
    compiled.body_mocapid[1] = -1
    sight = eyes.Eyes(compiled, [EYE], hide=())
    _, xpos, xmat = places(model_of(still), [1.0, 0.3, 0.5], [0, 0, 0])
    bare = eyes.Eyes(model_of(), [EYE])
    # The second is out of view, the third is before all and has no size.
    centers = jnp.array([[0.0, 0.1, 0.0], [0.0, 9.0, 0.0], [0.5, 0.2, 0.25]])
    boxes = centers, jnp.array([[0.3, 0.1, 0.2], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    found = distance(bare, xpos, xmat, boxes)
    assert np.array_equal(distance(sight, xpos, xmat), found) and np.isfinite(found).any()
    assert len(np.unique(picture(bare, xpos, xmat, boxes))) > 4


def test_heights_of_an_episode_stand_for_those_of_the_model():
    """4 s. Against MuJoCo's rays and normals, inside a wide field whose heights are other ones."""
    model, random = model_of(KINDS["field"].replace("euler", 'pos=".1 0 -.3" euler')), EPISODE
    sight = eyes.Eyes(model, [EYE], (15, 15), reach=5.0)
    model.hfield_data[:] = random.ravel()
    data, xpos, xmat = places(model, [0.05, 0.1, 0.2], [0.3, 0.2, -0.2])
    found = distance(sight, xpos, xmat, None, 0.25 * random, jit=quick.jit)[0]
    right = rays_of_mujoco(model, data, EYE, 15)
    both = np.isfinite(found) & np.isfinite(right)
    assert both.mean() > 0.5
    np.testing.assert_allclose(found[both], right[both], rtol=1e-4)
    again = picture(eyes.Eyes(model, [EYE], (15, 15), reach=5.0), xpos, xmat, jit=quick.jit)
    assert np.array_equal(again, picture(sight, xpos, xmat, None, 0.25 * random, jit=quick.jit))
    assert len(np.unique(again)) > 5  # each triangle is lit as it lies


def test_a_normal_of_a_field_is_that_of_its_triangle():
    random = np.random.default_rng(0)
    heights, point = random.uniform(size=(4, 6)), random.uniform(-1, 1, (50, 3))
    normals = shapes._normal_of_field(jnp.float32(point), jnp.float32(heights))
    for (x, y, _), normal in zip(point, np.asarray(normals), strict=True):
        column, row = int(2.5 * (x + 1)), int(1.5 * (y + 1))
        right = 2.5 * (x + 1) - column > 1.5 * (y + 1) - row
        corners = [(row, column), (row + 1, column + 1), (row + (not right), column + right)]
        a, b, c = (np.array([j / 2.5 - 1, i / 1.5 - 1, heights[i, j]]) for i, j in corners)
        other = np.cross(b - a, c - a)
        assert np.allclose(normal, other / other[2], atol=1e-5)


def test_upright_and_right_way_round():
    """A picture's upper row is the sky, and a left eye sees more of what is on the left."""
    ball = '<geom type="sphere" size=".1" pos="0 .5 0" rgba="1 1 1 1"/>'
    model = model_of(ball)
    _, xpos, xmat = places(model, [-1.0, 0.0, 0.0], [0, 0, 0])
    seen = np.isfinite(distance(eyes.Eyes(model, [EYE], (9, 9)), xpos, xmat))[0]
    assert seen[:, :4].any() and not seen[:, 4:].any()  # it is on the left
    left, right = np.isfinite(
        eyes.Eyes(model, eyes.pair(EYE, 0.1, 0.0), (9, 9)).distance(xpos, xmat)
    )
    assert left[:, 4:].any() and not right.any()
    greys = picture(eyes.Eyes(model, [EYE], (9, 9)), xpos, xmat)[0]
    assert greys[0, 8] == round(255 * SKY) and greys[8, 8] == round(255 * ABYSS)


def test_light_falls_from_above_and_the_ground_has_checks():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom type="plane" size="0 0 1" rgba=".5 .5 .5 1"/>'
        '<body name="head" pos="0 0 .5"><geom type="sphere" size=".1" rgba=".5 .5 .5 1"/></body>'
        "</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    down = eyes.Eye("world", (0.3, 0.0, 1.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), 40.0)
    up = dataclasses.replace(down, position=(0.3, 0.0, 0.01), direction=(-0.3, 0.0, 0.49))
    xpos, xmat = jnp.float32(data.xpos), jnp.float32(data.xmat.reshape(-1, 3, 3))
    ground = picture(eyes.Eyes(model, [down], hide=["head"], check=0.2), xpos, xmat)
    greys, counts = np.unique(ground, return_counts=True)
    assert len(greys) == 2 and counts.min() > 0.3 * ground.size  # flat, so lit alike: two greys
    low, high = map(float, greys)
    assert abs((high - low) / (high + low) - CONTRAST) < 0.02
    ball = picture(eyes.Eyes(model, [up]), xpos, xmat)[0, 16, 16]
    assert ball == round(255 * 0.5 * SHADE)  # from below, where no light falls


def test_checks_that_are_too_small_fade():
    """The ground near the horizon is its mean grey: it would flicker otherwise."""
    model = model_of('<geom type="plane" size="0 0 1" rgba=".5 .5 .5 1"/>')
    model.body_mocapid[1] = -1
    model.geom_bodyid[:] = 0
    _, xpos, xmat = places(model, [0.0, 0, 0.3], [10.0, 0, 0.3])
    seen = picture(eyes.Eyes(model, [EYE], (64, 64), reach=1e3), xpos, xmat)[0].astype(float)
    assert seen[34:37].std(axis=1).max() < 3 < 40 < seen[60:].std(axis=1).min()


def test_what_is_hidden_clear_or_far_is_not_seen():
    ball = '<geom name="ball" type="sphere" size=".1" {}/>'
    _, xpos, xmat = places(model_of(ball.format("")), [-1.0, 0.0, 0.0], [0, 0, 0])

    def seen(extra: str, **words) -> bool:
        sight = eyes.Eyes(model_of(ball.format(extra)), [EYE], (9, 9), **words)
        return bool(np.isfinite(distance(sight, xpos, xmat)).any())

    assert seen("")
    assert not seen("", reach=0.8)
    with pytest.raises(ValueError, match="There is nothing to see: every geom is hidden"):
        seen("", hide=["ball"])
    for clear in ('rgba="1 1 1 0"', 'group="3"'):
        with pytest.raises(ValueError, match="There is nothing to see"):
            seen(clear)


def test_an_eye_looks_through_what_it_is_in():
    """As MuJoCo's renderer, which draws no surface from behind: dm_control's rat needs it."""
    model = model_of(KINDS["sphere"], head='<geom type="ellipsoid" size=".2 .1 .1"/>')
    data, xpos, xmat = places(model, [-1.0, 0.1, 0.0], [0.1, 0.1, 0])
    bare = model_of(KINDS["sphere"])
    one, other = (distance(eyes.Eyes(m, [EYE], (9, 9)), xpos, xmat) for m in (model, bare))
    assert np.array_equal(one, other) and np.isfinite(one).any()


def test_a_camera_of_the_model_is_an_eye():
    own = eyes.of_camera(model_of(), "own")
    assert own.body == "head" and own.fovy == 70.0
    np.testing.assert_allclose([own.position, own.direction, own.up],
                               [[0, 0, 0.1], [1, 0, 0], [0, 0, 1]], atol=1e-9)  # fmt: skip


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: eyes.Eye("head", fovy=180.0), "fovy is 180.0; give degrees, 5 to less than 180."),
        (lambda: eyes.Eye("head", fovy=1.4), "fovy is 1.4; give degrees, 5 to less than 180."),
        (lambda: eyes.Eye("head", up=(2.0, 0, 0)), "are parallel or 0"),
        (
            lambda: eyes.pair(EYE, 0.1, 61.0),
            "overlap is 61.0; give degrees, 0 to the eye's fovy, 60",
        ),
        (lambda: eyes.of_camera(model_of(), "owm"), "There is no camera 'owm'. Did you mean 'own'"),
        (lambda: eyes.of_camera(model_of(), "after"), "Camera 'after' follows a body"),
        (lambda: eyes.Eyes(model_of(), [eyes.Eye("had")]), "There is no body 'had'"),
        (lambda: eyes.Eyes(model_of(), [EYE], hide=["x"]), "There is no body or geom 'x'"),
        (lambda: eyes.Eyes(model_of(), [EYE], (0, 3)), "size is .0, 3.; give .H, W., whole"),
        (lambda: eyes.Eyes(model_of(), [EYE], (16, 9.5)), "whole numbers from 1 to 4096"),
        (lambda: eyes.Eyes(model_of(), [EYE], 16), "size is 16; give"),
        (lambda: eyes.Eyes(model_of(), [EYE], reach=float("nan")), "reach is nan and check 0.1"),
        (lambda: eyes.Eye("head", (0.0, 0.1)), "position is .0.0, 0.1.; give three finite numbers"),
        (lambda: eyes.Eye("head", up=(0, 0, np.nan)), "up is .*; give three finite numbers"),
        (lambda: eyes.Eyes(model_of(), []), "give at least one eye"),
        (lambda: eyes.Eyes(mesh(), [EYE]), "do not see a mesh, and geom 'stone' is one"),
        (
            lambda: eyes.Eyes(model_of(*2 * [KINDS["field"].replace('name="hill" ', "")]), [EYE]),
            "Eyes see one height field, and 2 are here: `hide` others",
        ),
        (
            lambda: eyes.Eyes(model_of(KINDS["field"]), [EYE]).see(
                jnp.zeros((3, 3)), jnp.zeros((3, 3, 3)), None, jnp.zeros((7, 5))
            ),
            r"heights are \(7, 5\), those of the model's height field \(5, 7\): give \[nrow, ncol",
        ),
    ],
)
def test_mistakes_are_a_line(make, message):
    with pytest.raises(ValueError, match=message) as error:
        make()
    assert "\n" not in str(error.value)


def mesh() -> mujoco.MjModel:
    """A model with a mesh."""
    return mujoco.MjModel.from_xml_string(
        '<mujoco><asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset><worldbody>'
        '<geom name="stone" type="mesh" mesh="m"/><body name="head"/></worldbody></mujoco>'
    )
