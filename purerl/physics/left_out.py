"""What an engine leaves out of a model without a word: it is refused, or the motion is another."""

import operator

import mujoco
import numpy as np

# Fields that an engine's code never reads, and the value at which they do nothing. The other fields
# that it never reads are in tests/physics/unread.toml, each with the reason why that is harmless.
_JAX = """
opt.noslip_iterations opt.disableactuator actuator_armature actuator_damping actuator_dampingpoly
actuator_actearly dof_dampingpoly jnt_stiffnesspoly tendon_dampingpoly tendon_stiffnesspoly
geom_adhesion pair_adhesion geom_surfacevel geom_gap pair_gap geom_fluid"""
_PLUGINS = ("actuator_plugin", "body_plugin", "geom_plugin", "sensor_plugin")
LEFT_OUT: dict[str, dict[str, int]] = {
    "c": {},
    "jax": dict.fromkeys(_JAX.split(), 0) | dict.fromkeys(_PLUGINS, -1) | {"actuator_ctrlnum": 1},
    "warp": {"opt.disableactuator": 0, "actuator_armature": 0},
}
# By MJX's rays.
_UNSEEN = [int(getattr(mujoco.mjtGeom, f"mjGEOM_{x}")) for x in ("CYLINDER", "HFIELD", "SDF")]


def check_left_out(model: mujoco.MjModel, engine: str) -> None:
    """Raises ValueError for what an engine ("c", "jax", "warp") leaves out silently."""
    found = [what for what, there in _combinations(model)[engine].items() if there]
    for name, idle in LEFT_OUT[engine].items():
        values = np.ravel(operator.attrgetter(name)(model))
        found += [f"{name} = {x}" for x in values[values != idle]]
    if found:
        raise ValueError(
            f"The model has {found[0]}, which engine {engine!r} does not have and leaves out "
            "without a word: remove it, on every engine, or use engine 'c'."
        )


def _combinations(model: mujoco.MjModel) -> dict[str, dict[str, bool]]:
    """Returns what each engine leaves out that is in no field alone, and whether it is there."""
    opt, bit = model.opt, mujoco.mjtDisableBit
    integrator = mujoco.mjtIntegrator(opt.integrator).name.removeprefix("mjINT_")
    bits = (bit.mjDSBL_SPRING, bit.mjDSBL_DAMPER, bit.mjDSBL_EULERDAMP)
    springs, dampers, explicit = (bool(opt.disableflags & int(one)) for one in bits)
    rays = model.sensor_type == mujoco.mjtSensor.mjSENS_RANGEFINDER
    plain = (model.sensor_objtype == mujoco.mjtObj.mjOBJ_SITE) & (model.sensor_intprm[:, 0] == 1)
    unseen = np.isin(model.geom_type, _UNSEEN)
    damped = model.dof_damping.any() and integrator == "EULER"
    pairs = model.body_weldid[model.geom_bodyid[np.array([model.pair_geom1, model.pair_geom2])]]
    dense = not mujoco.mj_isSparse(model)
    late = (model.sensor_needstage == mujoco.mjtStage.mjSTAGE_ACC) & (integrator == "RK4")
    either = {"a rangefinder on a camera, or with other data than dist": (rays & ~plain).any()}
    jax = {
        "a rangefinder, and a cylinder or height field": rays.any() and unseen.any(),
        'a tendon\'s armature, and no jacobian="sparse"': model.tendon_armature.any() and dense,
        "a contact pair within one body": (np.diff(pairs, axis=0) == 0).any(),
        "a tactile sensor": (model.sensor_type == mujoco.mjtSensor.mjSENS_TACTILE).any(),
        "the integrator discrete": integrator == "DISCRETE",
        "only one of springs and dampers disabled": springs != dampers,
        "dampers disabled, and eulerdamp not": damped and dampers and not explicit,
    }
    warp = {
        "sensors of accelerations under RK4, at its first stage": late.any(),
        'gaintype="user"': (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_USER).any(),
    }
    return {"c": {}, "jax": either | jax, "warp": either | warp}
