"""What MJX and MJX-Warp leave out of a model: found in their sources, and refused or harmless."""

import ast
import enum
import fnmatch
import functools
import importlib
import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from purerl.physics.interface import Physics
from purerl.physics.left_out import LEFT_OUT
from tests.quick import jit

# The packages, and the functions of `io.py` that read or refuse what a model has.
PACKAGES = {"jax": "mujoco.mjx._src", "warp": "mujoco.mjx.third_party.mujoco_warp._src"}
SET_UP = ("_put_model_jax", "_put_option", "_make_data_jax", "put_model", "make_data")
TYPES = ("types", "io")  # they name every field, whoever reads it


@functools.cache
def read_by(engine):
    """Returns the attributes that an engine's code reads: names, and (owner, name)."""
    folder = Path(mjx.__file__).parent.joinpath(*PACKAGES[engine].split(".")[2:])
    todo, trees = ["forward"], {}
    while todo:
        name = todo.pop()
        path = folder / f"{name}.py"
        if name in trees or name in TYPES or not path.exists():
            continue
        trees[name] = ast.parse(path.read_text())
        for node in ast.walk(trees[name]):
            if isinstance(node, ast.ImportFrom | ast.Import):
                parts = [alias.name for alias in node.names] + [getattr(node, "module", "") or ""]
                todo += [part.split(".")[-1] for part in parts]
    assert len(trees) > 12, sorted(trees)
    io = ast.parse((folder / "io.py").read_text()).body
    set_up = [node for node in io if getattr(node, "name", "") in SET_UP]
    assert len(set_up) >= 2
    found = set()
    for tree in [*trees.values(), *set_up]:
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute):
                owner = getattr(node.value, "attr", getattr(node.value, "id", ""))
                found |= {node.attr, (owner, node.attr)}
    return found


def fields():
    """Returns the names of all arrays of a model and of all options."""
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    arrays = [n for n in dir(model) if isinstance(getattr(model, n), np.ndarray)]
    return arrays + [f"opt.{n}" for n in dir(model.opt) if not n.startswith("_")]


def values(engine):
    """Returns MuJoCo's names of all bits, and of the values that an engine takes, by its own."""
    types = importlib.import_module(f"{PACKAGES[engine]}.types")
    names = {("DisableBit", n.split("_")[1]): n for n in dir(mujoco.mjtDisableBit) if "DSBL_" in n}
    names |= {("EnableBit", n.split("_")[1]): n for n in dir(mujoco.mjtEnableBit) if "ENBL_" in n}
    kinds = dict(Integrator="INT", Cone="CONE", Jacobian="JAC", Solver="SOL", Joint="JNT", Eq="EQ")
    kinds |= dict(Geom="GEOM", Wrap="WRAP", Trn="TRN", Dyn="DYN", Gain="GAIN", Bias="BIAS")
    for kind, short in (kinds | dict(Sensor="SENS")).items():
        members = getattr(getattr(types, f"{kind}Type", enum.Enum), "__members__", {})
        names |= {(f"{kind}Type", name): f"mj{short}_{name}" for name in members}
    return names


def unread(engine):
    """Returns the fields and values that an engine's code never reads."""
    read = read_by(engine)
    left = [name for name in fields() if name.removeprefix("opt.") not in read]
    left += [c for own, c in values(engine).items() if own not in read and c not in read]
    return set(left)


def harmless(engine):
    """Returns the patterns of the table."""
    table = tomllib.loads((Path(__file__).parent / "unread.toml").read_text())["unread"]
    assert all(row["why"] for row in table)
    return [name for row in table if engine in row["engines"] for name in row["names"].split()]


@pytest.mark.parametrize("engine", ["jax", "warp"])
def test_what_an_engine_never_reads_is_refused_or_known_to_be_harmless(engine):
    left, known = unread(engine), harmless(engine)
    refused = {*LEFT_OUT[engine]}
    assert "opt.disableactuator" in left and "actuator_armature" in left
    matched = {n for n in left if any(fnmatch.fnmatchcase(n, k) for k in known)}
    assert not left - matched - refused, "neither refused nor on the list: look at what C does"
    assert not matched & refused
    assert refused <= left, "refused, though the engine's code has it now"


@pytest.mark.parametrize("engine", ["jax", "warp"])
def test_the_list_has_nothing_that_an_engine_reads(engine):
    everything = unread("jax") | unread("warp")
    idle = [k for k in harmless(engine) if not fnmatch.filter(everything, k)]
    assert not idle


ARM = """<mujoco><asset><material name="m"/></asset>
<option {option}><flag {flag}/></option>
<worldbody><geom type="{floor}" size="1 1 .1" pos="0 0 -2"/>
<body><joint name="hinge" axis="0 1 0" {joint}/><site name="tip" pos=".3 0 0"/><camera name="eye"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" {geom}/></body></worldbody>
<actuator><general name="motor" joint="hinge" group="1" {actuator}/></actuator>
<sensor>{sensor}</sensor></mujoco>"""
RAY = '<rangefinder site="tip"/>'
ACCELEROMETER = '<accelerometer site="tip"/>'


def arm(**parts):
    """Returns a hinge with a motor; parts are attributes of its MJCF."""
    none = dict.fromkeys(("option", "flag", "joint", "geom", "actuator", "sensor"), "")
    text = ARM.format(**{**none, "floor": "plane", **parts})
    return mujoco.MjModel.from_xml_string(text)


@pytest.mark.parametrize(
    ("parts", "engines", "said"),
    [
        ({"actuator": 'damping="1.5"'}, "jax", "actuator_damping = 1.5"),
        ({"actuator": 'armature="0.5"'}, "jax warp", "actuator_armature = 0.5"),
        ({"actuator": 'dyntype="filter" dynprm="1" actearly="true"'}, "jax", "actearly = True"),
        ({"option": 'actuatorgroupdisable="1"'}, "jax warp", "opt.disableactuator = 2"),
        ({"option": 'noslip_iterations="3"'}, "jax", "opt.noslip_iterations = 3"),
        ({"option": 'integrator="discrete"'}, "jax", "the integrator discrete"),
        ({"actuator": 'gaintype="user"'}, "warp", 'gaintype="user"'),
        ({"geom": 'fluidshape="ellipsoid"'}, "jax", "geom_fluid = 1"),
        ({"geom": 'gap="0.1"'}, "jax", "geom_gap = 0.1"),
        ({"geom": 'surfacevel="1 0 0 0 0 0"'}, "jax", "geom_surfacevel = 1"),
        ({"joint": 'damping="0 2 1"'}, "jax", "dof_dampingpoly = 2"),
        ({"joint": 'stiffness="0 5 50"'}, "jax", "jnt_stiffnesspoly = 5"),
        ({"flag": 'spring="disable"'}, "jax", "only one of springs and dampers"),
        (
            {"flag": 'spring="disable" damper="disable"', "joint": 'damping="1"'},
            "jax",
            "dampers disabled, and eulerdamp not",
        ),
        ({"sensor": RAY, "floor": "cylinder"}, "jax", "a rangefinder, and a cylinder"),
        ({"sensor": RAY.replace("/", ' data="point"/')}, "jax warp", "other data than dist"),
        ({"sensor": '<rangefinder camera="eye"/>'}, "jax warp", "a rangefinder on a camera"),
        ({"sensor": ACCELEROMETER, "option": 'integrator="RK4"'}, "warp", "under RK4"),
    ],
)
def test_what_an_engine_would_leave_out_is_refused(monkeypatch, parts, engines, said):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: True)  # the rule needs no package
    model = arm(**parts)
    Physics(model, (), 1, "c")
    for engine in engines.split():
        with pytest.raises(ValueError, match=f"The model has .*{said}.* engine '{engine}'"):
            Physics(model, (), 1, engine)


def test_a_plugin_is_refused():
    cable = '<plugin plugin="mujoco.elasticity.cable"/>'
    text = f"""<mujoco><extension>{cable}</extension><worldbody>
      <composite type="cable" curve="s" count="5 1 1" size="1" initial="none">
      {cable}<geom type="capsule" size=".005"/></composite></worldbody></mujoco>"""
    with pytest.raises(ValueError, match="body_plugin = 0.* engine 'jax'"):
        Physics(mujoco.MjModel.from_xml_string(text), (), 1, "jax")


def test_what_mjx_cannot_trace_is_told_when_it_is_built():
    model = mujoco.MjModel.from_xml_string(
        ARM.format(
            **dict.fromkeys(("option", "flag", "joint", "geom", "actuator"), ""),
            floor="plane",
            sensor=RAY,
        ).replace('<material name="m"/>', "")
    )
    Physics(model, ("sensordata",), 1, "c")
    with pytest.raises(ValueError, match="MJX cannot simulate.*a rangefinder needs a <material>"):
        Physics(model, (), 1, "jax")
    Physics(arm(sensor=RAY), ("sensordata",), 1, "jax")


def test_a_model_without_joints_is_refused_when_it_is_built():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>"
    )
    with pytest.raises(ValueError, match="MJX cannot simulate.*zero DoFs"):
        Physics(model, (), 1, "jax")


def test_an_elliptic_cone_without_contacts_is_refused_when_it_is_built():
    model = arm(option='cone="elliptic"', joint='range="-1 1"', floor="sphere")
    model.geom_contype[:] = 0
    with pytest.raises(ValueError, match="MJX cannot simulate this model: Indexer"):
        Physics(model, (), 1, "jax")


PAIR = """<mujoco><option jacobian="{jacobian}"/><worldbody>
<body name="a"><joint name="a"/><geom name="a" size=".1"/><geom name="b" size=".1"/></body>
<body name="b" pos="1 0 0"><joint name="b"/><geom size=".1"/></body></worldbody>{rest}</mujoco>"""
TENDON = """<tendon><fixed armature="1"><joint joint="a" coef="1"/><joint joint="b" coef="1"/>
</fixed></tendon>"""


@pytest.mark.parametrize(
    ("jacobian", "rest", "said"),
    [
        ("auto", '<equality><weld body1="a" body2="b"/></equality>', None),  # `check` tells of it
        ("auto", '<contact><pair geom1="a" geom2="b"/></contact>', "a contact pair within one"),
        ("auto", TENDON, 'a tendon\'s armature, and no jacobian="sparse"'),
        ("sparse", TENDON, None),
    ],
)
def test_what_mjx_has_otherwise_between_bodies_is_refused(jacobian, rest, said):
    model = mujoco.MjModel.from_xml_string(PAIR.format(jacobian=jacobian, rest=rest))
    Physics(model, (), 1, "c")
    if said is None:
        Physics(model, (), 1, "jax")
        return
    with pytest.raises(ValueError, match=f"The model has {said}"):
        Physics(model, (), 1, "jax")


@pytest.mark.slow
def test_under_rk4_readings_are_of_the_stages_that_mujoco_has():
    model = arm(
        option='integrator="RK4" timestep="0.01"',
        flag='contact="disable"',
        sensor=ACCELEROMETER,
    )
    names = ("qacc", "actuator_force", "sensordata")
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.3
    mujoco.mj_step(model, data, 2)
    physics = Physics(model, names, 2, "jax")
    state = Physics(model, (), 1, "c").init(jnp.zeros(1), jnp.zeros(1))[0]
    found = jit(physics._engine.plain_step)(state, jnp.full(1, 0.3), {})[1]
    for name, value in zip(names, found, strict=True):
        np.testing.assert_allclose(value, getattr(data, name), rtol=1e-3, err_msg=name)


@pytest.mark.parametrize("substeps", [2.0, 0, "2"])
def test_substeps_are_a_whole_number(substeps):
    with pytest.raises(ValueError, match="substeps is "):
        Physics(arm(), (), substeps, "c")


def test_an_edit_after_the_build_is_told():
    model = arm()
    physics = Physics(model, (), 1, "c")
    start = jnp.zeros(1), jnp.zeros(1)
    state, _ = physics.init(*start)
    model.geom_rgba[:] = 0.5  # that is for a drawing
    physics.step(state, jnp.zeros(1))
    model.opt.iterations = 3
    with pytest.raises(ValueError, match="opt.iterations was edited after"):
        physics.step(state, jnp.zeros(1))
    model.opt.iterations = 100
    model.body_mass[1] = 3.0
    with pytest.raises(ValueError, match="body_mass was edited after.*changes="):
        physics.init(*start)


FREE = """<mujoco><worldbody><body mocap="true"/><body>{0}<geom size=".1"/></body></worldbody>
</mujoco>"""


@pytest.mark.parametrize("joint", ["<freejoint/>", "<joint type='ball'/>"])
@pytest.mark.parametrize("engine", ["c", "jax"])
def test_a_quaternion_of_zeros_is_told(engine, joint):
    model = mujoco.MjModel.from_xml_string(FREE.format(joint))
    physics = Physics(model, (), 1, engine)
    velocity = jnp.zeros(model.nv)
    physics.init(model.qpos0, velocity)
    with pytest.raises(ValueError, match="a quaternion of zeros"):
        physics.init(jnp.zeros(model.nq), velocity)
    zeros = {"body_quat": jnp.zeros((3, 4))}
    with pytest.raises(ValueError, match="a quaternion of zeros"):
        physics.init(model.qpos0, velocity, zeros)
    later = jax.jit(lambda qpos: physics.init(qpos, velocity)[0].qpos)
    np.testing.assert_array_equal(later(model.qpos0), np.float32(model.qpos0))
    assert np.isnan(later(np.zeros(model.nq))).all()
