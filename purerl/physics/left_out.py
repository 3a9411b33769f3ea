"""What an engine leaves out of a model without a word: it is refused, or the motion is another."""

import operator
from typing import Any

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
# Values that an engine's code takes, and then does nothing with.
LEFT_OUT_VALUES: dict[str, dict[str, Any]] = {
    "c": {},
    "jax": {
        "opt.integrator": mujoco.mjtIntegrator.mjINT_DISCRETE,
        "sensor_type": mujoco.mjtSensor.mjSENS_TACTILE,
    },
    "warp": {"actuator_gaintype": mujoco.mjtGain.mjGAIN_USER},
}
_UNSEEN = [int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in ("CYLINDER", "HFIELD", "SDF")]


def check_left_out(model: mujoco.MjModel, engine: str) -> None:
    """Raises ValueError for what an engine ("c", "jax", "warp") leaves out silently."""
    found = [what for what, there in _combinations(model)[engine].items() if there]
    for name, idle in LEFT_OUT[engine].items():
        values = np.ravel(operator.attrgetter(name)(model))
        found += [f"{name} = {x}" for x in values[values != idle]]
    for name, value in LEFT_OUT_VALUES[engine].items():
        found += [value.name] * bool(np.isin(int(value), operator.attrgetter(name)(model)))
    if found:
        raise ValueError(
            f"The model has {found[0]}, which engine {engine!r} does not have and leaves out "
            "without a word: remove it, on every engine, or use engine 'c'."
        )


def _combinations(model: mujoco.MjModel) -> dict[str, dict[str, bool]]:
    """Returns what each engine leaves out that is in no field alone, and whether it is there."""
    rays = model.sensor_type == mujoco.mjtSensor.mjSENS_RANGEFINDER
    plain = (model.sensor_objtype == mujoco.mjtObj.mjOBJ_SITE) & (model.sensor_intprm[:, 0] == 1)
    either = {"a rangefinder on a camera, or with other data than dist": (rays & ~plain).any()}
    opt, bit = model.opt, mujoco.mjtDisableBit
    springs, dampers, explicit = (
        bool(opt.disableflags & one)
        for one in (bit.mjDSBL_SPRING, bit.mjDSBL_DAMPER, bit.mjDSBL_EULERDAMP)
    )
    implicit = opt.integrator == mujoco.mjtIntegrator.mjINT_EULER and not explicit
    late = model.sensor_needstage == mujoco.mjtStage.mjSTAGE_ACC
    rk4 = opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    mjx = {
        "a rangefinder, and a cylinder or height field": rays.any()
        and np.isin(model.geom_type, _UNSEEN).any(),
        "only one of springs and dampers disabled": springs != dampers,
        "dampers disabled, and eulerdamp not": dampers and implicit and model.dof_damping.any(),
    }
    of_warp = {"sensors of accelerations under RK4, at its first stage": rk4 and late.any()}
    return {"c": {}, "jax": either | mjx, "warp": either | of_warp}
