"""MuJoCo behind one small stateless interface, whatever the engine."""

import collections
import copy
import functools
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
from purerl.physics import changes as fields, left_out

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

# Fields that MuJoCo computes only for the sake of a sensor: without one they hold old values.
_OF_BODY_FORCES = ["accelerometer", "force", "torque", "framelinacc", "frameangacc"]
_NEEDS_SENSOR = dict.fromkeys(("cacc", "cfrc_int", "cfrc_ext"), _OF_BODY_FORCES)
_NEEDS_SENSOR |= {f"subtree_{x}": ["subtreelinvel", "subtreeangmom"] for x in ("linvel", "angmom")}


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
    (`{"geom_friction": [ngeom, 3]}`). Fields are set as they are. From masses, sizes, armatures,
    places of bodies, ... MuJoCo derives constants (`body_subtreemass`, `dof_M0`, `geom_rbound`,
    ...): `derive` adds them, and changes without them are refused. Numbers that the compiler works
    out of an MJCF's shorthand stay: `dampratio`, a mass from a density. `body_pos` of a mocap body
    says where `init` puts it.

    A simulation that blows up, or is given NaN, returns NaN and touches no other.

    On `warp` contacts and constraints have buffers of a fixed size, on `c` the model's memory
    (`<size memory="..."/>`). If that is too small for a step, some are left out, and the reading
    "overflow" ([], of these engines) is 1 and not 0. If it is not read, such a simulation has blown
    up. `overflow_reading`, for `warp`, and `overflow_metric` make a metric of it.
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
        readings = (readings,) if isinstance(readings, str) else tuple(readings)
        self.engine = choose_engine(engine)
        _check_model(model, tuple(n for n in readings if n != "overflow" or self.engine == "jax"))
        left_out.check_left_out(model, self.engine)
        if not isinstance(substeps, int | np.integer) or substeps < 1:
            raise ValueError(f"substeps is {substeps!r}: a control step needs 1, 2, 3 or more.")
        self.model, self.substeps = model, substeps
        self._built = fields.numbers(model, fields.CHANGEABLE_FIELDS)
        late = (model.sensor_needstage == mujoco.mjtStage.mjSTAGE_ACC).any()
        self.reads_forces = bool({*_ACCELERATION, *["sensordata"] * bool(late)} & {*readings})
        self._follows = functools.cache(functools.partial(fields.consequences, copy.copy(model)))
        self.control_timestep = substeps * float(model.opt.timestep)
        record: Any = collections.namedtuple("Readings", readings)  # type: ignore[misc]
        self._engine = _build_engine(self.engine, model, record, substeps)

    def __deepcopy__(self, memo: dict) -> "Physics":
        """Returns itself: nothing in it changes."""
        return self

    def init(
        self,
        qpos: Array,
        qvel: Array,
        changes: dict[str, Array] | None = None,
        ctrl: Array | None = None,
        act: Array | None = None,
    ) -> tuple[PhysicsState, PyTree]:
        """Starts a simulation.

        Args:
          qpos: positions [nq].
          qvel: velocities [nv].
          changes: this simulation's fields of the model.
          ctrl: controls [nu] under which forces and accelerations are read; None: zeros. A robot
            of position servos is held by those of its pose.
          act: activations [na], as of muscles, that the state begins with; None: zeros.
        """
        model, changes = self.model, self.check_changes(changes)
        fields.check_shape("qpos", qpos, (model.nq,))
        fields.check_shape("qvel", qvel, (model.nv,))
        act = _float32(np.zeros(model.na) if act is None else act)
        fields.check_shape("act", act, (model.na,))
        if ctrl is not None:
            fields.check_shape("ctrl", ctrl, (model.nu,))
            ctrl = _float32(ctrl)
        qpos = fields.refuse_zero_rotations(model, qpos, changes)
        mocap = np.argsort(model.body_mocapid, kind="stable")[model.nbody - model.nmocap :]
        state = PhysicsState(
            qpos=_float32(qpos),
            qvel=_float32(qvel),
            act=act,
            time=jnp.zeros((), jnp.float32),
            qacc_warmstart=jnp.zeros(model.nv, jnp.float32),
            mocap_pos=_float32(changes.get("body_pos", model.body_pos))[mocap],
            mocap_quat=_float32(changes.get("body_quat", model.body_quat))[mocap],
        )
        return state, self._engine.init(state, changes, ctrl)

    def step(
        self, state: PhysicsState, ctrl: Array, changes: dict[str, Array] | None = None
    ) -> tuple[PhysicsState, PyTree]:
        """Advances one control step (`substeps` physics steps) under ctrl [nu]."""
        fields.check_shape("ctrl", ctrl, (self.model.nu,))
        return self._engine.step(state, _float32(ctrl), self.check_changes(changes))

    @property
    def stepped_by(self) -> list[str] | None:
        """What computes the steps traced so far, or None where there is no choice.

        On a GPU, on `jax`, up to a humanoid's size: "one kernel" and who compiled it, or "XLA: "
        and why.
        """
        return getattr(self._engine, "stepped_by", None)

    def derive(self, changes: dict[str, Array]) -> dict[str, Array]:
        """Returns changes with the constants that MuJoCo derives from them, such as `dof_M0`.

        Call it once, in `reset`, keep what it returns in `State.task`, and give that to `init` and
        to every `step`. MuJoCo computes it on the host, so that on a GPU a program with it is
        compiled anew at each start.

        Args:
          changes: MjModel field names -> this simulation's values, of the field's own shape.

        Raises:
          ValueError: an unknown field, another shape, or a change that cannot act or be followed.
        """
        fields.check_fields(self.model, self.engine, changes)
        behind = {constant for name in changes for constant in self._follows(name)}
        wanted = tuple(sorted(behind & set(fields.CONSTANTS) - set(changes)))
        more = fields.derive(self.model, changes, wanted) if wanted else {}
        return self.check_changes({**changes, **more})

    def check_changes(self, changes: dict[str, Array] | None) -> dict[str, Array]:
        """Returns changes in float32; ValueError for those that cannot act, or are half."""
        fields.check_unedited(self.model, self._built)
        fields.check_fields(self.model, self.engine, changes or {})
        return fields.check_whole(self.model, changes or {}, self._follows)


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
