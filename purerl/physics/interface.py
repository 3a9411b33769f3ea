"""MuJoCo behind one small stateless interface, whatever the engine."""

import collections
import importlib.util
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

import purerl
from purerl.core.errors import unknown_name
from purerl.core.records import Array, PyTree
from purerl.physics.as_built import check_unedited, numbers, refuse_zero_rotations
from purerl.physics.left_out import LEFT_OUT, check_left_out

ENGINES = ("auto", "c", "jax", "warp")

_POSITION = """
xpos xquat xmat xipos ximat xanchor xaxis geom_xpos geom_xmat site_xpos site_xmat cam_xpos cam_xmat
subtree_com cinert crb cdof ten_length actuator_length""".split()  # noqa: SIM905
_VELOCITY = """
cvel cdof_dot ten_velocity actuator_velocity qfrc_bias qfrc_passive subtree_linvel
subtree_angmom""".split()  # noqa: SIM905
_ACCELERATION = """
qacc act_dot actuator_force qfrc_actuator qfrc_smooth qacc_smooth qfrc_constraint cacc cfrc_int
cfrc_ext""".split()  # noqa: SIM905
READINGS = (*_POSITION, *_VELOCITY, *_ACCELERATION, "sensordata")

# Fields of MjModel that may differ between environments, on every engine: a test compares them with
# those that MJX traces, so that the `c` engine need not import MJX, which takes seconds.
CHANGEABLE_FIELDS = tuple(
    """
    actuator_acc0 actuator_actrange actuator_biasprm actuator_cranklength actuator_ctrlrange
    actuator_dynprm actuator_forcerange actuator_gainprm actuator_gear actuator_lengthrange
    body_gravcomp body_inertia body_invweight0 body_ipos body_iquat body_mass body_pos body_quat
    body_subtreemass cam_fovy cam_intrinsic cam_mat0 cam_pos cam_pos0 cam_poscom0 cam_quat dof_M0
    dof_armature dof_damping dof_dampingpoly dof_frictionloss dof_invweight0 dof_solimp dof_solref
    eq_data eq_solimp eq_solref geom_aabb geom_friction geom_gap geom_margin geom_pos geom_quat
    geom_rbound geom_rgba geom_size geom_solimp geom_solmix geom_solref jnt_actfrcrange jnt_axis
    jnt_margin jnt_pos jnt_range jnt_solimp jnt_solref jnt_stiffness jnt_stiffnesspoly
    light_ambient light_attenuation light_cutoff light_diffuse light_dir light_dir0 light_exponent
    light_pos light_pos0 light_poscom0 light_specular mat_emission mat_rgba mat_shininess
    mat_specular pair_friction pair_gap pair_margin pair_solimp pair_solref pair_solreffriction
    qpos0 qpos_spring site_pos site_quat tendon_actfrcrange tendon_armature tendon_damping
    tendon_dampingpoly tendon_frictionloss tendon_invweight0 tendon_length0 tendon_lengthspring
    tendon_margin tendon_range tendon_solimp_fri tendon_solimp_lim tendon_solref_fri
    tendon_solref_lim tendon_stiffness tendon_stiffnesspoly
    """.split()  # noqa: SIM905
)

# Fields that MuJoCo computes only for the sake of a sensor: without one they hold old values.
_OF_BODY_FORCES = ["accelerometer", "force", "torque", "framelinacc", "frameangacc"]
_NEEDS_SENSOR = dict.fromkeys(("cacc", "cfrc_int", "cfrc_ext"), _OF_BODY_FORCES)
_NEEDS_SENSOR |= dict.fromkeys(
    ("subtree_linvel", "subtree_angmom"), ["subtreelinvel", "subtreeangmom"]
)


class PhysicsState(struct.PyTreeNode):
    """The integration state of one simulation: all it needs to go on, and no more.

    float32 on every engine. MuJoCo's C code computes in float64, and rounds its state at each
    control step on purpose: what goes on is what a checkpoint holds and what another engine sees.
    """

    qpos: Array  # [nq] positions [m or rad; quaternions]
    qvel: Array  # [nv] velocities [m/s or rad/s]
    act: Array  # [na] actuator activations
    time: Array  # [] simulated time [s]
    qacc_warmstart: Array  # [nv] solver's starting point; without it a resumed run differs
    mocap_pos: Array  # [nmocap, 3] [m]
    mocap_quat: Array  # [nmocap, 4]


class Physics:
    """One `mujoco.MjModel` on one engine.

    `init` and `step` describe ONE simulation and are pure under jit, vmap, nested vmap and scan.

    Readings are a NamedTuple with the fields asked for at construction, float32, of the same
    shapes on every engine. As in dm_control, those that depend on positions and velocities are of
    the state returned. Those that depend on accelerations (`actuator_force`, `qfrc_actuator`,
    `cfrc_ext`, accelerometers, touch, ...) are of the last substep, which led to that state.

    `changes` maps MjModel field names to this simulation's values, of the field's own shape
    (`{"geom_friction": [ngeom, 3]}`). Fields are set as they are. Constants that the model
    compiler derives from them (`body_invweight0`, `body_subtreemass`, ... of `mj_setConst`) do not
    follow: change those too where it matters (for the mass of a lone free body also `dof_M0`, which
    the C code reads). The centre of mass of a lone free body cannot follow `body_ipos`: put it into
    a body of its own.

    A simulation that blows up, or is given NaN, returns NaN and touches no other.

    On `warp` contacts and constraints have buffers of a fixed size. If they are too small for a
    step, some are left out, and the reading "overflow" ([], that engine's alone) is 1 and not 0.
    If it is not read, such a simulation has blown up. `overflow_reading` and `overflow_metric` make
    a metric of it.
    """

    model: mujoco.MjModel
    engine: str  # "c", "jax" or "warp"
    substeps: int
    control_timestep: float  # substeps * model.opt.timestep [s]

    def __init__(
        self,
        model: mujoco.MjModel,
        readings: tuple[str, ...] = (),
        substeps: int = 5,
        engine: str = "auto",
    ):
        """Prepares the model for an engine.

        Args:
          model: the compiled model.
          readings: names of derived `mujoco.MjData` fields, of `READINGS`.
          substeps: physics steps in one control step.
          engine: "c" (MuJoCo on the CPU), "jax" (MJX), "warp" (MJX-Warp), or "auto": "c" where JAX
            runs on a CPU, else "jax".

        Raises:
          ValueError: an unknown engine or reading, or a model with state that is not carried.
        """
        if not isinstance(model, mujoco.MjModel):
            raise ValueError(
                f"model is a {type(model).__name__}; it must be a mujoco.MjModel, such as "
                "mujoco.MjModel.from_xml_path(path)."
            )
        self.engine = choose_engine(engine)
        _check_model(model, tuple(n for n in readings if n not in overflow_reading(self.engine)))
        check_left_out(model, self.engine)
        if not isinstance(substeps, int | np.integer) or substeps < 1:
            raise ValueError(f"substeps is {substeps!r}: a control step needs 1, 2, 3 or more.")
        self.model, self.substeps, self._built = model, substeps, numbers(model, CHANGEABLE_FIELDS)
        self.control_timestep = substeps * float(model.opt.timestep)
        record: Any = collections.namedtuple("Readings", list(readings))  # type: ignore[misc]
        self._engine = _build_engine(self.engine, model, record, substeps)

    def init(
        self, qpos: Array, qvel: Array, changes: dict[str, Array] | None = None
    ) -> tuple[PhysicsState, PyTree]:
        """Starts a simulation at qpos [nq], qvel [nv], with no activation and no control."""
        model, changes = self.model, self._check_changes(changes)
        _check_shape("qpos", qpos, (model.nq,))
        _check_shape("qvel", qvel, (model.nv,))
        qpos = refuse_zero_rotations(model, qpos, changes)
        mocap = np.argsort(model.body_mocapid, kind="stable")[model.nbody - model.nmocap :]
        state = PhysicsState(
            qpos=_float32(qpos),
            qvel=_float32(qvel),
            act=jnp.zeros(model.na, jnp.float32),
            time=jnp.zeros((), jnp.float32),
            qacc_warmstart=jnp.zeros(model.nv, jnp.float32),
            mocap_pos=_float32(changes.get("body_pos", model.body_pos))[mocap],
            mocap_quat=_float32(changes.get("body_quat", model.body_quat))[mocap],
        )
        return state, self._engine.init(state, changes)

    def step(
        self, state: PhysicsState, ctrl: Array, changes: dict[str, Array] | None = None
    ) -> tuple[PhysicsState, PyTree]:
        """Advances one control step (`substeps` physics steps) under ctrl [nu]."""
        _check_shape("ctrl", ctrl, (self.model.nu,))
        return self._engine.step(state, _float32(ctrl), self._check_changes(changes))

    def _check_changes(self, changes: dict[str, Array] | None) -> dict[str, Array]:
        check_unedited(self.model, self._built)
        for name, value in (changes or {}).items():
            if name not in CHANGEABLE_FIELDS:
                what = "model field that can change"
                raise ValueError(unknown_name(what, name, CHANGEABLE_FIELDS))
            _check_shape(f"changes[{name!r}]", value, getattr(self.model, name).shape)
            _check_has_effect(self.model, name, self.engine)
        return {name: _float32(value) for name, value in (changes or {}).items()}


def _check_has_effect(model: mujoco.MjModel, name: str, engine: str) -> None:
    """Raises for a field that an engine heeds only where the model was compiled with some of it."""
    value = getattr(model, name)
    if name == "body_gravcomp" and not value.any():
        missing = "some body"
    elif engine == "jax" and name.endswith("_frictionloss") and not value.all():
        missing = "all of them"
    elif name in LEFT_OUT[engine]:
        raise ValueError(f"changes[{name!r}] does nothing on engine {engine!r}: it has no such.")
    else:
        return
    raise ValueError(
        f"changes[{name!r}] would do nothing: compile the model with {name} above 0 for {missing}."
    )


def choose_engine(engine: str) -> str:
    """Resolves "auto" and refuses what cannot run here."""
    if engine not in ENGINES:
        raise ValueError(unknown_name("engine", engine, ENGINES))
    if engine == "warp" and importlib.util.find_spec("warp") is None:
        raise ValueError(
            "engine 'warp' (MJX-Warp) cannot run here: it needs the warp-lang package "
            f"({purerl.how_to_install('warp')}) and an NVIDIA GPU. "
            "Use 'jax' on a GPU, 'c' on a CPU."
        )
    if engine == "auto":
        return "c" if jax.default_backend() == "cpu" else "jax"
    return engine


def overflow_reading(engine: str) -> tuple[str, ...]:
    """Returns the reading of left out contacts, for an engine that may leave some out."""
    return ("overflow",) if choose_engine(engine) == "warp" else ()


def overflow_metric(readings: PyTree) -> dict[str, Array]:
    """Returns the metric of it, summed over an episode: control steps that lacked contacts."""
    return {"overflow_count": readings.overflow} if hasattr(readings, "overflow") else {}


def _build_engine(engine: str, model: mujoco.MjModel, record: Any, substeps: int) -> Any:
    """Imports only the engine asked for: MJX alone takes seconds to import."""
    if engine == "c":
        from purerl.physics.engine_c import CEngine

        return CEngine(model, record, _stage(model, record._fields), substeps)
    late = tuple(n for n in record._fields if n in _ACCELERATION or n == "sensordata")
    if engine == "warp":
        from purerl.physics.engine_warp import WarpEngine

        return WarpEngine(model, record, late, substeps)
    from purerl.physics.engine_mjx import JaxEngine

    return JaxEngine(model, record, late, substeps)


def _stage(model: mujoco.MjModel, readings: tuple[str, ...]) -> int:
    """The least `mujoco.mjtStage` that makes the readings current at the new state."""
    position, velocity = int(mujoco.mjtStage.mjSTAGE_POS), int(mujoco.mjtStage.mjSTAGE_VEL)
    stages = [position for name in readings if name in _POSITION]
    stages += [velocity for name in readings if name in _VELOCITY]
    if "sensordata" in readings:
        stages += [int(stage) for stage in model.sensor_needstage if stage <= velocity]
    return max(stages, default=int(mujoco.mjtStage.mjSTAGE_NONE))


def _check_model(model: mujoco.MjModel, readings: tuple[str, ...]) -> None:
    """Raises unless everything the model and the readings need is carried between steps."""
    held = {
        "plugin state (npluginstate)": model.npluginstate,
        "control or sensor delays (nhistory)": model.nhistory,
        "sleeping bodies (mjENBL_SLEEP)": model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP,
    }
    for what, amount in held.items():
        if amount:
            raise ValueError(
                f"The model has {what}, which purerl does not carry between control steps, so a "
                "resumed run would differ. Remove it from the model."
            )
    for name in readings:
        if name not in READINGS:
            raise ValueError(unknown_name("reading", name, READINGS))
        kinds = _NEEDS_SENSOR.get(name, [])
        needed = [int(getattr(mujoco.mjtSensor, f"mjSENS_{kind.upper()}")) for kind in kinds]
        if needed and not np.isin(model.sensor_type, needed).any():
            raise ValueError(
                f"MuJoCo computes {name!r} only for a model with a sensor that needs it: add one "
                f"of {', '.join(kinds)}."
            )
    off = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_SENSOR
    if off and any(n == "sensordata" or n in _NEEDS_SENSOR for n in readings):
        raise ValueError("A reading needs sensors, and the model has them disabled: enable them.")


def _float32(value: Any) -> Array:
    return jnp.asarray(value, jnp.float32)


def _check_shape(name: str, value: Any, shape: tuple[int, ...]) -> None:
    if jnp.shape(value) != shape:
        raise ValueError(
            f"{name} has shape {jnp.shape(value)}; one simulation of this model takes {shape}. "
            "Batches are the caller's vmap."
        )
