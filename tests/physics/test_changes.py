"""What differs between simulations: what follows from it, and what cannot act."""

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from purerl.physics import changes as fields, lookup, reasons
from purerl.physics.changes import CHANGEABLE_FIELDS, CONSTANTS, consequences
from purerl.physics.interface import Physics

ZOO = """<mujoco><compiler angle="radian"/>
<worldbody><light pos="0 0 3"/><camera pos="1 1 1"/><geom type="plane" size="1 1 .1"/>
<body name="goal" mocap="true" pos="1 0 0"><geom size=".02"/></body>
<body name="shelf" pos="3 0 0"><geom type="box" size=".1 .1 .1"/></body>
<body name="ball" pos="3 0 1" simple="false"><freejoint/><geom size=".1"/></body>
<body name="torso" pos="0 0 1"><freejoint/><geom type="capsule" size=".1 .2"/>
 <light mode="trackcom" pos="0 0 2"/><camera mode="trackcom" pos="0 -2 0"/>
 <camera mode="targetbody" target="ball" pos="0 -2 0"/>
 <body name="arm" pos=".2 0 0"><joint type="ball" range="0 1"/><site name="s1" pos=".1 .02 0"/>
  <geom type="ellipsoid" size=".05 .06 .07" pos=".1 0 0"/>
  <body name="hand" pos=".3 0 .1" quat="1 .1 0 0"><joint name="h" axis="0 1 0" range="-1 1"/>
   <geom name="wrapper" type="cylinder" size=".05 .1" pos="0.05 0 0"/>
   <site name="s2" pos=".2 0 .1"/>
   <body name="finger" pos="0 .2 0"><joint name="s" type="slide" axis="1 0 0" armature=".1"/>
    <geom type="box" size=".02 .03 .04"/></body></body></body></body></worldbody>
<equality><connect body1="torso" body2="ball" anchor="0 0 0"/><weld body1="hand" body2="ball"/>
</equality>
<tendon><spatial name="t" stiffness="3"><site site="s1"/><geom geom="wrapper"/><site site="s2"/>
</spatial><fixed armature=".1"><joint joint="h" coef="1"/><joint joint="s" coef="2"/></fixed>
</tendon>
<actuator><motor joint="h"/><muscle tendon="t" ctrlrange="0 1"/>
<motor site="s2" gear="1 0 0 0 1 0" refsite="s1"/></actuator></mujoco>"""
ELEMENTS = {"body": "bodies", "geom": "geoms", "jnt": "joints", "dof": "joints", "site": "sites"}
ELEMENTS |= {"cam": "cameras", "light": "lights", "tendon": "tendons", "actuator": "actuators"}
# What the compiler and mj_setConst derive, and need not follow.
UNREAD = {
    "bvh_aabb bvh_nodeid body_margin": "of the midphase, which engine c then has off",
    "geom_sameframe site_sameframe body_sameframe": "engine c reads each frame then",
    "dof_length actuator_length0": "of sleep, which is refused; of the compiler's own work",
    "qpos0 qpos_spring": "changeable themselves: a free body's follow its place in an MJCF",
}
HARMLESS = {name for names in UNREAD for name in names.split()}
BY_HAND = {"tendon_lengthspring", "actuator_lengthrange"}


def zoo():
    """Returns the MjSpec of a model with everything, its inertias given."""
    spec = mujoco.MjSpec.from_string(ZOO)
    model = spec.compile()
    for body in spec.bodies[1:]:
        body.explicitinertial, body.fullinertia = True, [np.nan] * 6
        for name in ("mass", "ipos", "iquat", "inertia"):
            setattr(body, name, getattr(model, f"body_{name}")[body.id])
    return spec


@pytest.fixture(scope="module")
def model():
    return zoo().compile()


def arrays(model):
    names = (n for n in dir(model) if not n.startswith("_"))
    return {n: np.copy(x) for n in names if isinstance(x := getattr(model, n), np.ndarray)}


def differing(one, other):
    return {n for n, x in arrays(one).items() if not np.allclose(x, getattr(other, n), 1e-5, 1e-7)}


def other_values(value, name):
    """Returns a field a little changed, as float32 has it."""
    own = value * (1.0 + 0.1 * np.random.default_rng(0).uniform(size=value.shape)) + 0.003
    own = np.float32(own).astype(float)
    return own / np.linalg.norm(own, axis=1, keepdims=True) if name.endswith("quat") else own


@pytest.mark.parametrize("name", CHANGEABLE_FIELDS)
def test_all_that_mujoco_derives_from_a_field_is_known(model, name):
    """Whatever mj_setConst changes, in one row or another, is a known consequence or harmless."""
    changed = copy.copy(model)
    getattr(changed, name)[...] = other_values(getattr(model, name), name)
    if name in ("body_pos", "body_quat"):
        getattr(changed, name)[model.body("goal").id] = getattr(model, name)[model.body("goal").id]
    if name in ("body_ipos", "body_iquat"):
        simple = model.body_simple > 0
        getattr(changed, name)[simple] = getattr(model, name)[simple]
    before = copy.copy(changed)
    mujoco.mj_setConst(changed, mujoco.MjData(changed))
    found = differing(before, changed) - HARMLESS - {name}
    assert found <= set(CONSTANTS)
    if name not in CONSTANTS:
        assert found <= set(consequences(model, name))


def recompiled(name, model):
    """Compiles the zoo with other values of a field; None where an MJCF has no such."""
    spec, (kind, attribute) = zoo(), name.split("_", 1)
    wanted = other_values(getattr(model, name), name)
    for element in getattr(spec, ELEMENTS[kind]):
        value = wanted[model.jnt_dofadr[element.id] if kind == "dof" else element.id]
        fixed = kind == "body" and (element.id == 0 or model.body_mocapid[element.id] >= 0)
        if fixed or (attribute in ("ipos", "iquat") and model.body_simple[element.id]):
            continue
        own = getattr(element, attribute)
        if attribute in ("range", "armature") and not np.ravel(own)[-1 if kind == "jnt" else 0] > 0:
            continue
        if attribute == "range" and element.type == mujoco.mjtJoint.mjJNT_BALL:
            continue
        if np.ndim(own):
            own = np.array(own)
            own[: np.size(value)] = np.ravel(value)[: len(own)]
        else:
            own = float(np.ravel(value)[0])
        setattr(element, attribute, own)
    return spec.compile()


WRITTEN = """
body_mass body_inertia body_ipos body_iquat body_pos body_quat geom_size geom_pos geom_quat
jnt_pos dof_armature site_pos site_quat cam_pos cam_quat light_pos light_dir tendon_armature
actuator_gear jnt_range tendon_stiffness geom_margin"""


@pytest.mark.parametrize("name", WRITTEN.split())
def test_what_is_derived_is_what_the_compiler_has(model, name):
    right = recompiled(name, model)
    follows = set(consequences(model, name))
    wanted = tuple(sorted(follows - BY_HAND))
    row = np.ravel(getattr(right, name))[None].astype(np.float32)
    found, end = copy.copy(model), 0
    getattr(found, name)[...] = getattr(right, name)
    values = fields._derive_rows(model, (name,), wanted, row) if wanted else None
    for constant in wanted:
        field = getattr(found, constant)
        field[...] = values[0, end : end + field.size].reshape(field.shape)
        end += field.size
    assert getattr(right, name).tobytes() != getattr(model, name).tobytes()
    unknown = differing(found, right) - HARMLESS - (BY_HAND & follows)
    # Of a free body the compiler takes qpos0 from its place, and with it what stands at qpos0.
    assert unknown <= ({"cam_mat0", *CONSTANTS} if name in ("body_pos", "body_quat") else set())


def scaled(model, factor):
    """Masses and inertias, as a user writes them."""
    return {n: factor * np.float32(getattr(model, n)) for n in ("body_mass", "body_inertia")}


LINKS = """<mujoco><worldbody><body pos="1 0 1"><freejoint/><geom size=".1" mass="{0}"/>
<body pos="1 0 0"><joint axis="0 1 0"/><geom size=".1" mass="{1}"/></body></body></worldbody>
</mujoco>"""
PUCK = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="x" type="slide"
axis="1 0 0"/><joint type="slide" axis="0 1 0"/><geom size=".1" mass="{0}"/></body></worldbody>
<actuator><motor joint="x"/></actuator></mujoco>"""
BALL = """<mujoco><worldbody><geom type="box" size="{0} {0} .05"/><body pos=".3 .3 .3"><freejoint/>
<geom size=".05"/></body></worldbody></mujoco>"""


def run(model, changes=None, steps=1, ctrl=(), engine="c"):
    """Returns state and readings after physics steps."""
    physics = Physics(model, ("subtree_com",), max(steps, 1), engine)
    changes = physics.derive(changes or {})
    state, read = physics.init(model.qpos0, np.zeros(model.nv), changes)
    return physics.step(state, jnp.array(ctrl, float), changes) if steps else (state, read)


@pytest.mark.usefixtures("compiled_quickly")
@pytest.mark.parametrize("engine", ["c", pytest.param("jax", marks=pytest.mark.slow)])
def test_a_changed_model_moves_as_one_that_is_compiled_so(engine):
    load = mujoco.MjModel.from_xml_string
    light, heavy = load(LINKS.format(1, 1)), load(LINKS.format(3, 3))
    np.testing.assert_allclose(
        run(light, scaled(light, 3.0), 0, engine=engine)[1].subtree_com,
        run(heavy, {}, 0)[1].subtree_com,
        atol=1e-6,
    )
    puck = load(PUCK.format(1))
    fast = run(puck, scaled(puck, 4.0), 50, (1.0,), engine)[0].qvel[0]
    assert fast == pytest.approx(0.025, rel=1e-4)
    armature = run(puck, {"dof_armature": np.full(2, 3.0)}, 50, (1.0,), engine)[0].qvel[0]
    assert armature == pytest.approx(0.025, rel=1e-4)
    small = load(BALL.format(0.05))
    size = np.float32(small.geom_size)
    size[0, :2] = 0.5
    assert run(small, {"geom_size": size}, 500, (), engine)[0].qpos[2] == pytest.approx(
        0.0996, 1e-2
    )


@pytest.mark.parametrize("engine", ["c", "jax"])
def test_half_a_change_is_refused_by_name(engine):
    puck = mujoco.MjModel.from_xml_string(PUCK.format(1))
    physics = Physics(puck, (), 1, engine)
    start, changes = (np.zeros(2), np.zeros(2)), scaled(puck, 4.0)
    with pytest.raises(ValueError, match=r"'body_mass'\] alone is half.* dof_M0 .*derive"):
        physics.init(*start, changes)
    with pytest.raises(ValueError, match="alone is half"):
        jax.eval_shape(lambda k: physics.init(*start, {n: k * x for n, x in changes.items()}), 2.0)
    physics.init(*start, scaled(puck, 1.0))  # the model's own
    whole = physics.derive(changes)
    assert set(whole) >= {"dof_M0", "body_subtreemass", "dof_invweight0"}
    physics.check_changes(whole)
    with pytest.raises(ValueError, match=r"jnt_axis.*simple one.*simple=\"false\""):
        physics.check_changes({"jnt_axis": np.ones((2, 3))})


def test_derived_constants_are_each_simulations_own():
    puck = mujoco.MjModel.from_xml_string(PUCK.format(1))
    physics, masses = Physics(puck, (), 1, "c"), jnp.arange(1.0, 4.0)
    armatures = jax.jit(jax.vmap(lambda m: physics.derive({"dof_armature": jnp.full(2, m)})))
    np.testing.assert_allclose(armatures(masses)["dof_M0"], 1.0 + np.tile(masses[:, None], 2))


def test_a_place_may_change_where_nothing_follows(model):
    """A goal, or a shelf that no joint moves; not an arm's link."""
    physics = Physics(model, (), 1, "c")
    place = np.float32(model.body_pos)
    place[[model.body("goal").id, model.body("shelf").id]] += 0.1
    physics.check_changes({"body_pos": place})
    site = np.float32(model.site_pos)
    with pytest.raises(ValueError, match="tendon_length0.* and .*lengthrange by hand"):
        physics.check_changes({"site_pos": site + 0.1})
    later = jax.jit(lambda x: physics.check_changes({"body_pos": x})["body_pos"])
    np.testing.assert_array_equal(later(place), place)
    place[model.body("hand").id] += 0.1
    assert np.isnan(later(place)).any()
    with pytest.raises(ValueError, match=r"body_pos.* alone is half a change"):
        physics.check_changes({"body_pos": place})


def test_a_margin_that_grew_is_heeded():
    text = """<mujoco><option gravity="0 0 0"/><worldbody>
      <body><joint type="slide"/><geom size=".05"/><geom size=".01" pos=".1 0 0"/></body>
      <body pos="0 0 .2"><freejoint/><geom size=".05"/><geom size=".01" pos=".1 0 0"/></body>
      </worldbody><sensor><touch site="s"/></sensor></mujoco>"""
    text = text.replace('<geom size=".05"/>', '<geom size=".05"/><site name="s"/>', 1)
    model = mujoco.MjModel.from_xml_string(text)
    physics = Physics(model, ("qfrc_constraint",), 1, "c")
    wide = {"geom_margin": np.full(model.ngeom, 0.15)}
    forces = physics.init(model.qpos0, np.zeros(model.nv), wide)[1].qfrc_constraint
    changed = copy.copy(model)
    changed.geom_margin[:] = 0.15
    data = mujoco.MjData(changed)
    mujoco.mj_setConst(changed, data)
    mujoco.mj_forward(changed, data)
    assert data.ncon and np.abs(data.qfrc_constraint).max() > 0.1
    np.testing.assert_allclose(forces, data.qfrc_constraint, atol=1e-3)


@pytest.mark.parametrize(
    "name", ["jnt_range", "jnt_actfrcrange", "actuator_ctrlrange", "actuator_forcerange"]
)
def test_a_change_that_cannot_act_is_refused(name):
    puck = mujoco.MjModel.from_xml_string(PUCK.format(1))
    with pytest.raises(ValueError, match=f"{name}.* would do nothing .*limit"):
        Physics(puck, (), 1, "c").check_changes({name: np.ones(getattr(puck, name).shape)})


SERVO = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="j" type="hinge"
axis="0 1 0"/><geom size=".1" pos=".3 0 0"/><site name="s" pos=".3 0 0"/></body></worldbody>
<actuator><position joint="j" kp="20"/></actuator><sensor><accelerometer site="s"/></sensor>
</mujoco>"""
MUSCLE = SERVO.replace('<position joint="j" kp="20"/>', '<muscle joint="j" lengthrange="-1 1"/>')


@pytest.mark.parametrize("engine", ["c", pytest.param("jax", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("text", "given"), [(SERVO, {"ctrl": 0.9}), (MUSCLE, {"act": 0.5})])
def test_the_first_readings_are_under_the_control_and_activation_of_init(engine, text, given):
    model = mujoco.MjModel.from_xml_string(text)
    physics = Physics(model, ("actuator_force", "sensordata"), 1, engine)
    pose, data = np.full(1, 0.9), mujoco.MjData(model)
    data.qpos[:] = pose
    for name, value in given.items():
        getattr(data, name)[:] = value
    mujoco.mj_forward(model, data)
    named = {name: np.full(1, value) for name, value in given.items()}
    state, read = physics.init(pose, np.zeros(1), **named)
    np.testing.assert_allclose(read.actuator_force, data.actuator_force, atol=1e-4)
    np.testing.assert_allclose(read.sensordata, data.sensordata, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(state.act, data.act)
    plain = physics.init(pose, np.zeros(1))[1]
    assert np.abs(plain.actuator_force - data.actuator_force).max() > 1.0
    with pytest.raises(ValueError, match=r"ctrl has shape \(2,\)"):
        physics.init(pose, np.zeros(1), ctrl=np.zeros(2))


def test_contacts_without_memory_are_counted_or_lost():
    boxes = "".join(
        f'<body pos="{0.3 * i} 0 .1"><freejoint/><geom type="box" size=".1 .1 .1"/></body>'
        for i in range(12)
    )
    text = f"""<mujoco><size memory="{{}}"/><worldbody><geom type="plane" size="5 5 1"/>{boxes}
    </worldbody></mujoco>"""

    def fall(memory, names):
        model = mujoco.MjModel.from_xml_string(text.format(memory))
        physics = Physics(model, names, 2, "c")
        state, _ = physics.init(model.qpos0, np.zeros(model.nv))
        return physics.step(state, np.zeros(0))

    reasons.said.clear()
    assert fall("1M", ("overflow",))[1].overflow == 0
    assert not reasons.most()
    state, read = fall("45K", ("overflow",))
    assert read.overflow == 1 and np.isfinite(state.qpos).all()
    assert "times: Insufficient arena memory" in reasons.most()
    assert np.isnan(fall("45K", ())[0].qpos).all()


TWO = """<mujoco><worldbody><body><joint name="b" type="ball"/><geom size=".1"/><body pos="1 0 0">
<joint name="h"/><geom size=".1"/></body></body></worldbody><actuator>
<orientation name="o" joint="b" kp="1" {}/><motor name="m" joint="h" {}/></actuator></mujoco>"""


def test_actuators_of_several_controls_are_named_by_control():
    limit = 'ctrlrange="-1 1"'
    model = mujoco.MjModel.from_xml_string(TWO.format("", limit))
    assert lookup.names(model, "actuator") == ["o", "o", "o", "m"]
    assert (lookup.find(model, "actuator", "o"), lookup.find(model, "actuator", "m")) == (0, 3)
    with pytest.raises(ValueError, match="without a ctrlrange: o. Give"):
        lookup.scale_action(model, jnp.zeros(4))
    model = mujoco.MjModel.from_xml_string(TWO.format(limit, ""))
    with pytest.raises(ValueError, match="without a ctrlrange: m. Give"):
        lookup.scale_action(model, jnp.zeros(4))
    with pytest.raises(ValueError, match="'x'. .*o, m"):
        lookup.find(model, "actuator", "x")


def test_a_moved_center_of_mass_is_heeded():
    """The compiler marks it where it is the body's place, or a geom's."""
    text = """<mujoco><worldbody><body simple="false"><joint axis="0 1 0"/><geom size=".1"/>
      <body pos="1 0 0"><joint axis="0 1 0"/><geom type="box" size=".1 .2 .3" pos=".1 0 0"/>
      </body></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)
    names = ("xipos", "ximat", "geom_xpos")
    physics = Physics(model, names, 1, "c")
    changes = {"body_ipos": model.body_ipos + 0.1, "body_iquat": np.tile([0.6, 0.8, 0, 0], (3, 1))}
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    found = physics.init(model.qpos0, np.zeros(2), physics.derive(changes))[1]
    np.testing.assert_allclose(found.xipos[1:] - data.xipos[1:], 0.1, atol=1e-6)
    np.testing.assert_allclose(
        found.ximat[1], [[1, 0, 0], [0, -0.28, -0.96], [0, 0.96, -0.28]], atol=1e-6
    )
    np.testing.assert_allclose(found.geom_xpos, data.geom_xpos, atol=1e-6)


def test_a_tendon_that_a_geom_may_bend_has_its_length_anew():
    """A peg beside a straight tendon: it does not bend it until it moves far enough."""
    text = """<mujoco><worldbody><site name="a"/><geom name="peg" type="sphere" size=".1"
      pos=".5 0 {}"/><body pos="1 0 0"><joint type="slide" axis="1 0 0"/><geom size=".01"/>
      <site name="b"/></body></worldbody><tendon><spatial limited="true" range="0 1">
      <site site="a"/><geom geom="peg"/><site site="b"/></spatial></tendon></mujoco>"""
    model, bent = (mujoco.MjModel.from_xml_string(text.format(z)) for z in (0.5, 0.05))
    derived = Physics(model, (), 1, "c").derive({"geom_pos": bent.geom_pos})
    assert derived["tendon_length0"] == pytest.approx(bent.tendon_length0, abs=1e-6)
    assert derived["tendon_invweight0"] == pytest.approx(bent.tendon_invweight0, rel=1e-4)
    assert bent.tendon_length0 > model.tendon_length0 + 0.005
    with pytest.raises(ValueError, match="geom_pos.*half a change: .*tendon_length0"):
        Physics(model, (), 1, "c").check_changes({"geom_pos": bent.geom_pos})


def test_a_size_that_a_fluid_would_not_heed_is_refused():
    text = """<mujoco><option density="100"/><worldbody><body><freejoint/><geom size=".1"
      fluidshape="ellipsoid"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)
    with pytest.raises(ValueError, match="geom_size.*fluid: remove its fluidshape"):
        Physics(model, (), 1, "c").derive({"geom_size": 2 * model.geom_size})


def test_a_geom_is_seen_by_a_cameras_rays_where_changes_put_it():
    text = """<mujoco><worldbody><body><camera name="eye" resolution="3 3"/></body>
      <body pos="0 0 -3"><geom size=".1" pos="5 0 0"/><geom size=".1" pos="7 0 0"/></body>
      </worldbody><sensor><rangefinder camera="eye"/></sensor></mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)
    physics = Physics(model, ("sensordata",), 1, "c")
    none, nowhere = np.zeros(0), np.array(model.geom_pos)
    assert (physics.init(none, none)[1].sensordata == -1).all()
    nowhere[0] = 0.0
    seen = physics.init(none, none, physics.derive({"geom_pos": nowhere}))[1].sensordata
    assert seen.max() == pytest.approx(2.9, abs=1e-3)
