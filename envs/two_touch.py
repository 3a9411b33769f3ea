"""dm_control's two-touch: a body taps an orb, waits 0.8 s, and taps it again.

What is right depends on when the first tap was, which nothing tells: a policy needs a memory, or a
body whose motion takes so long. The orb, its place, its state and its clock are data of the
episode; after both taps it is elsewhere.
"""

import dataclasses
from typing import Any, Literal

import jax
import jax.numpy as jnp

from purerl import Array, Physics, PhysicsState, State, eyes as seeing, lookup
from purerl.envs import sight
from purerl.envs.arenas import TARGET, Floor
from purerl.envs.bodies import ANT, RODENT, Body
from purerl.envs.compose import PREFIX, Composed, compose
from purerl.envs.feeling import READINGS, felt
from purerl.envs.touch import touched

BEFORE, ONCE, TWICE, TOO_SOON, TOO_LATE = range(5)
HEIGHT, AREA = 0.14, 1.5  # of the orb: above the ground, +- from the middle [m]
REWARD, NEAR = 25.0, 0.01  # dm_control's: for a right tap; its share, each step, for being near
INTERVAL, TOLERANCE, DEBOUNCE, TIMEOUT = 0.8, 0.1, 0.2, 1.2  # [s]


@dataclasses.dataclass(frozen=True)
class Touching:
    """What of a body touches, by names without the prefix that composing gives them."""

    body: Body
    hands: tuple[str, ...]  # bodies: how near the nearest is is rewarded
    palms: tuple[str, ...]  # geoms, ellipsoids or capsules: what touches
    radius: float  # of the orb [m]


_FEET = ANT.end_effectors
TOUCHING = {
    "ant": Touching(ANT, _FEET, tuple(f.replace("foot", "ankle_geom") for f in _FEET), 0.1),
    "rodent": Touching(
        RODENT, ("hand_L", "hand_R"), ("hand_L_collision", "hand_R_collision"), 0.025
    ),
}


@dataclasses.dataclass(frozen=True)
class Options:
    """Settings of the task."""

    body: Literal["ant", "rodent"] = "rodent"
    """The body. dm_control has this task for the rodent; an ant taps with the lower legs."""
    eyes: sight.Sight = sight.Sight(number=1)
    """Without eyes it is told where the orb is."""
    area: float = AREA
    """The orb is within +- this of where the body starts, along x and y [m]."""
    tolerance: float = TOLERANCE
    """A second tap is right so much sooner or later than 0.8 s after the first [s]."""
    soon_cost: float = 0.0
    """Taken from the reward by a second tap that is too soon; else a hand stays at the orb."""
    near: float = NEAR
    """Earned in each step by a hand at the orb, as a share of a right tap's 25. Where it is large,
    the hand stays."""
    least_up: float = -2.0
    """An episode ends where the torso's up-axis has a z below this; -2: never."""
    substeps: int = 5
    """Physics steps in one control step."""


@dataclasses.dataclass(frozen=True)
class TwoTouch:
    """The environment; `build` makes one."""

    options: Options
    physics: Physics
    parts: Composed
    hands: tuple[int, ...]  # body ids
    palms: tuple[int, ...]  # geom ids: what touches
    radius: float  # of the orb [m]
    action_size: int
    eyes: seeing.Eyes | None

    @property
    def control_timestep(self) -> float:
        """Simulated time of one step [s]."""
        return self.physics.control_timestep

    def reset(self, key: Array) -> State:
        """Starts standing at the origin, turned anyhow."""
        turn_key, orb_key, eyes_key, later_key = jax.random.split(key, 4)
        half = jnp.pi * jax.random.uniform(turn_key)
        rest = jnp.asarray(self.physics.model.qpos0, jnp.float32)
        qpos = rest.at[3].set(jnp.cos(half)).at[6].set(jnp.sin(half))
        task = {"key": later_key, "eyes": sight.draw(eyes_key, self.options.eyes)}
        task |= {"orb": new_orb(orb_key, self.options.area)}
        place = jnp.asarray(self.physics.model.body_pos, jnp.float32)
        orb = lookup.find(self.physics.model, "body", TARGET)
        changes = {"body_pos": place.at[orb].set(task["orb"]["place"])}
        physics, readings = self.physics.init(qpos, jnp.zeros(self.physics.model.nv), changes)
        logic, action = task["orb"]["logic"], jnp.zeros(self.action_size)
        return self._state(physics, readings, task, jnp.zeros(()), outcomes(logic, logic), action)

    def step(self, state: State, action: Array) -> State:
        """Drives the actuators with action [A] in [-1, 1]."""
        task, orb = state.task, state.task["orb"]
        next_key, draw_key = jax.random.split(task["key"])
        moved = new_orb(draw_key, self.options.area)
        orb = jax.tree.map(lambda new, old: jnp.where(orb["over"], new, old), moved, orb)
        before = state.physics.replace(mocap_pos=orb["place"][None])
        ctrl = lookup.scale_action(self.physics.model, action)
        physics, readings = self.physics.step(before, ctrl)
        palms, place = self.palms, orb["place"]
        (touching,) = touched(self.parts.looks, palms, readings, place[None], self.radius)
        after, earned = tapped(orb, touching, physics.time, self.options.tolerance)
        task = task | {"key": next_key, "orb": after}
        counted = outcomes(orb["logic"], after["logic"])
        earned = earned - self.options.soon_cost * counted["taps_soon_count"]
        return self._state(physics, readings, task, earned, counted, action)

    def _state(
        self,
        physics: PhysicsState,
        readings: Any,
        task: dict,
        earned: Array,
        counted: dict[str, Array],
        action: Array,
    ) -> State:
        place, logic = task["orb"]["place"], task["orb"]["logic"]
        away = jnp.abs(readings.xpos[jnp.array(self.hands)] - place).sum(1)
        near = self.options.near * REWARD * jnp.exp(-3.0 * away).max()
        torso = self.parts.torso
        parts = felt(self.parts, physics, readings, action)
        parts.append(jax.nn.one_hot(logic, 5))  # dm_control tells it too, but not since when
        where = readings.xmat[torso].T @ (place - readings.xpos[torso])
        if self.eyes is None:
            observation: Any = jnp.concatenate([*parts, where])
        else:
            given = readings, task["eyes"], physics.time, self.options.eyes
            pictures = sight.look(self.eyes, *given)
            since = physics.time - jnp.maximum(task["orb"]["first"], 0.0)
            told = jnp.append(where, jnp.where(logic == ONCE, since, 0.0))
            observation = {"policy": jnp.concatenate(parts), "eyes": pictures, "privileged": told}
        return State(
            physics=physics,
            observation=observation,
            reward=near + earned,
            terminated=readings.xmat[torso, 2, 2] < self.options.least_up,
            truncated=jnp.zeros((), bool),
            metrics={"reward_near": near, "reward_tap": earned, "distance": away.min(), **counted},
            task=task,
        )  # fmt: skip


def new_orb(key: Array, area: float) -> dict[str, Array]:
    """Returns an orb that nobody has touched: where, what has happened, and when [s]."""
    place = jax.random.uniform(key, (2,), minval=-area, maxval=area)
    never, no = jnp.full((), -1.0, jnp.float32), jnp.zeros((), bool)
    clock = {"touched": never, "first": never, "second": never}
    return clock | {
        "place": jnp.append(place, HEIGHT),
        "logic": jnp.full((), BEFORE, jnp.int32),
        "once": no,
        "twice": no,
        "waits": no,
        "over": no,
    }


def tapped(
    orb: dict[str, Array], touching: Array, time: Array, tolerance: float = TOLERANCE
) -> tuple[dict[str, Array], Array]:
    """Moves an orb on by a control step, and returns the reward for taps, [].

    Args:
      orb: of `new_orb`.
      touching: [] bool: whether a palm touches it now.
      time: [] of the episode [s].
      tolerance: how far from `INTERVAL` after the first tap the second is right [s].
    """
    once = orb["once"] | touching
    touched = jnp.where(touching & ~orb["once"], time, orb["touched"])
    twice = orb["twice"] | (touching & once & (time > touched + DEBOUNCE))
    begins = (orb["logic"] == BEFORE) & once
    waiting = orb["logic"] == ONCE
    since = time - orb["first"]
    ends, late = waiting & twice & ~orb["twice"], waiting & (since > INTERVAL + tolerance)
    soon = ends & (since < INTERVAL - tolerance)
    right = ends & ~soon & ~late
    logic = jnp.where(begins, ONCE, orb["logic"])
    logic = jnp.where(ends, jnp.where(soon, TOO_SOON, TWICE), logic)
    logic = jnp.where(late, TOO_LATE, logic)
    after = orb["logic"] > ONCE
    orb = orb | {
        "once": once,
        "twice": twice,
        "touched": touched,
        "first": jnp.where(begins, time, orb["first"]),
        "second": jnp.where(ends | late, time, orb["second"]),
        "logic": logic.astype(jnp.int32),
        "waits": jnp.where(soon | late, True, orb["waits"] & (time <= orb["second"] + TIMEOUT)),
        "over": after & ~orb["waits"] & (time > orb["second"]),
    }
    return orb, REWARD * (begins | right).astype(jnp.float32)


def outcomes(before: Array, after: Array) -> dict[str, Array]:
    """Returns how many orbs were tapped a first time in a step, and how their second taps were."""
    counted = {"first": ONCE, "right": TWICE, "soon": TOO_SOON, "late": TOO_LATE}
    now = {name: (after == logic) & (before != logic) for name, logic in counted.items()}
    return {f"taps_{name}_count": x.astype(jnp.float32) for name, x in now.items()}


def build(options: Options = Options(), engine: str = "auto") -> TwoTouch:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    chosen = TOUCHING[options.body]
    body = chosen.body
    parts = compose(body, Floor(orb=chosen.radius), engine)
    eye = seeing.of_camera(parts.looks, PREFIX + body.camera)
    return TwoTouch(
        options=options,
        physics=Physics(parts.model, READINGS, options.substeps, engine),
        parts=parts,
        hands=tuple(lookup.find(parts.model, "body", PREFIX + name) for name in chosen.hands),
        palms=tuple(lookup.find(parts.looks, "geom", PREFIX + name) for name in chosen.palms),
        radius=chosen.radius,
        action_size=parts.model.nu,
        eyes=sight.build(parts.looks, eye, body.eye_distance, options.eyes, ()),
    )
