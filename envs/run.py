"""Run forward: the ant or the rodent, on a floor or across a corridor with gaps.

The speed that is rewarded is that of the walker's own centre of mass (the torso's subtree), never
the arena's. One episode's corridor and its random changes of the model are data in `state.task`,
drawn by `reset`, so that every environment has its own and a checkpoint holds them.
"""

import dataclasses
from typing import Any, Literal, get_args, get_type_hints

import jax
import jax.numpy as jnp

from purerl import (
    Array,
    Physics,
    PhysicsState,
    State,
    eyes as seeing,
    lookup,
    overflow_metric,
    overflow_reading,
)
from purerl.envs import body_parts, sight
from purerl.envs.arenas import (
    Arena,
    Floor,
    GapsCorridor,
    boxes_in_reach,
    course_changes,
    distances_to_next_edges,
    draw_course,
    gaps_crossed,
    platform_boxes,
)
from purerl.envs.bodies import ANT, RODENT, Body
from purerl.envs.body_parts import Parts
from purerl.envs.compose import PREFIX, Composed, compose
from purerl.envs.feeling import READINGS, felt, proprioception
from purerl.envs.randomization import Randomization, draw_factors, draw_stance, randomized_fields
from purerl.envs.trial import LANDED, outcome, steps_beyond

BODIES = {"ant": ANT, "rodent": RODENT}
BODY_READINGS = ("cinert", "cvel")


@dataclasses.dataclass(frozen=True)
class Options:
    """Settings of the task."""

    body: Literal["ant", "rodent"] = "ant"
    """Which of dm_control's walkers."""
    arena: Literal["floor", "gaps", "single_gap"] = "floor"
    """An endless floor, a corridor whose gaps differ in every episode, or a trial at one gap."""
    platform_length: tuple[float, float] = (1.5, 2.0)
    """Of `gaps`: least and greatest length of a platform [m]."""
    gap_length: tuple[float, float] = (0.05, 0.2)
    """With gaps: least and greatest length of a gap [m]."""
    corridor_width: float = 4.0
    """With gaps: beyond half of it on either side, the body falls [m]."""
    runway: float = 1.0
    """With gaps: from the start to the first gap [m]."""
    reward: Literal["speed", "target"] = "speed"
    """The weighted terms below, or dm_control's corridor reward: speed / target_speed in [0, 1]."""
    target_speed: float = 1.0
    """Speed that earns the whole of the target reward [m/s]."""
    forward_weight: float = 5.0
    """Reward for 1 m/s of the walker's centre of mass along x, per control step."""
    distance_weight: float = 1.0
    """Reward for each metre gained along x."""
    healthy_reward: float = 0.5
    """Reward for each control step that ends healthy."""
    control_weight: float = 0.1
    """Reward taken for the sum of squared actions."""
    least_height: float | None = None
    """Of the torso above the ground, below which the episode ends [m]; none: the body's own, below
    which it lies. Lower, a foot that slips into a gap is no end: the body can climb out."""
    healthy_turn: float | None = None
    """How far the torso may turn from the way ahead, seen from above, until the episode ends [rad];
    none: the body's own, for an ant no limit. Above pi, a rodent may run tail first."""
    healthy_up: float = 0.0
    """Least z of the torso's up-axis: below, the body lies on its back, which ends the episode."""
    reset_noise: float = 0.01
    """Half-width of the start's noise [rad, m/s, rad/s]."""
    substeps: int = 5
    """Physics steps in one control step."""
    observe_place: bool = False
    """Whether x and y of the torso can be felt (y always is in a corridor)."""
    observe_bodies: bool = False
    """Whether inertia and velocity of every body (`cinert`, `cvel`) can be felt."""
    proprioception: bool = False
    """Whether the observation is a dict that has what the body feels as `imitation` lays it out
    too, for parts of a network that has imitated."""
    eyes: sight.Sight = sight.Sight()
    """With eyes it is not told of edges; the observation is a dict, and the value function is."""
    randomization: Randomization = Randomization()
    """What differs between episodes beside the corridor."""


@dataclasses.dataclass(frozen=True)
class Run:
    """The environment; `build` makes one."""

    options: Options
    physics: Physics
    parts: Composed
    action_size: int
    eyes: seeing.Eyes | None
    limbs: Parts | None  # as `imitation` looks them up, where `proprioception` is asked for

    @property
    def control_timestep(self) -> float:
        """Simulated time of one step [s]."""
        return self.physics.control_timestep

    def reset(self, key: Array) -> State:
        """Starts standing, limbs and velocities drawn around rest, in a corridor of its own."""
        limbs_key, velocity_key, course_key, model_key = jax.random.split(key, 4)
        noise = self.options.reset_noise
        qpos, qvel = draw_stance(limbs_key, velocity_key, self.parts, noise)
        factors = draw_factors(model_key, self.options.randomization)
        task: dict[str, Any] = {"factors": factors}
        if factors:
            task["fields"] = self.physics.derive(randomized_fields(self.physics.model, factors))
        if isinstance(self.parts.arena, GapsCorridor):
            task["course"] = draw_course(course_key, self.parts.arena)
            task["crossed"] = jnp.zeros((), jnp.int32)
            if self.parts.arena.single_gap:
                task["beyond"] = jnp.zeros((), jnp.int32)
        if self.eyes:
            # Not of the keys above: a body without eyes draws what it always drew.
            task["eyes"] = sight.draw(jax.random.fold_in(key, 1), self.options.eyes)
        physics, readings = self.physics.init(qpos, qvel, self._changes(task, qpos[0]))
        center = readings.subtree_com[self.parts.torso, 0]
        return self._state(physics, readings, task, center, jnp.zeros(self.action_size))

    def step(self, state: State, action: Array) -> State:
        """Drives the actuators with action [A] in [-1, 1]."""
        ctrl = lookup.scale_action(self.physics.model, action)
        changes = self.model_changes(state)
        physics, readings = self.physics.step(state.physics, ctrl, changes)
        return self._state(physics, readings, state.task, state.task["center"], action)

    def model_changes(self, state: State) -> dict[str, Array]:
        """Returns this episode's model fields where the body is now (a video needs them too)."""
        return self._changes(state.task, state.physics.qpos[0])

    def scenery(self, state: State) -> tuple[Array, Array]:
        """Returns the whole course as boxes for a video: centers [P, 3], half sizes [P, 3] [m].

        Physics knows only the few platforms within the body's reach.
        """
        if "course" not in state.task:
            return jnp.zeros((0, 3)), jnp.zeros((0, 3))
        return platform_boxes(state.task["course"], self.options.corridor_width)

    def _changes(self, task: dict[str, Any], x: Array) -> dict[str, Array]:
        changes = dict(task.get("fields", {}))
        if isinstance(self.parts.arena, GapsCorridor):
            reach = self.parts.body.reach
            changes |= course_changes(self.parts.boxes, task["course"], x, reach)
        return changes

    def _state(
        self, physics: PhysicsState, readings: Any, task: dict, before: Array, action: Array
    ) -> State:
        """Makes the state after a step that moved the centre of mass from x = `before` [m]."""
        torso, center = self.parts.torso, readings.subtree_com[self.parts.torso, 0]
        speed = (center - before) / self.control_timestep
        height, up = readings.xpos[torso, 2], readings.xmat[torso, 2, 2]
        turn = jnp.abs(jnp.arctan2(readings.xmat[torso, 1, 0], readings.xmat[torso, 0, 0]))
        healthy = is_healthy(self.parts.body, self.options, height, up, turn)
        terms = reward_terms(self.options, speed, center - before, healthy, action)
        metrics = {"forward_velocity": speed, "height": height, "up": up, "turn": turn}
        metrics |= {f"reward_{name}": term for name, term in terms.items()}
        metrics |= overflow_metric(readings)
        task = task | {"center": center}
        finished = jnp.zeros((), bool)
        if isinstance(self.parts.arena, GapsCorridor):
            # Beyond the end there is no ground; having run all of the corridor is no failure.
            finished = healthy & (physics.qpos[0] >= self.parts.arena.length)
            crossed = jnp.maximum(gaps_crossed(task["course"], physics.qpos[0]), task["crossed"])
            # A body below its own healthy height has fallen in, however far it flew.
            stands = healthy & (height > self.parts.body.healthy_height[0])
            crossed = jnp.where(stands, crossed, task["crossed"])
            metrics["gaps_crossed_count"] = (crossed - task["crossed"]).astype(jnp.float32)
            task |= {"crossed": crossed}
        if "beyond" in task:
            steps = round(LANDED / self.control_timestep)
            ends = readings.xpos[jnp.array(self.parts.end_effectors)]
            task |= {"beyond": steps_beyond(task["beyond"], ends, task["course"])}
            finished = healthy & (task["beyond"] >= steps)
            first = physics.time < 1.5 * self.control_timestep
            metrics |= outcome(first, ~healthy, finished)
            metrics["gap_length"] = task["course"][1, 0] - task["course"][0, 1]
        return State(
            physics=physics,
            observation=self._observe(physics, readings, task, action),
            reward=sum(terms.values(), jnp.zeros(())),
            terminated=~healthy,
            truncated=finished,
            metrics=metrics,
            task=task,
        )

    def _observe(self, physics: PhysicsState, readings: Any, task: dict, action: Array) -> Any:
        """Returns [O]: posture and motion in the torso's own frame, forces, and what lies ahead.

        With eyes: a dict of `policy` [O], `eyes` [E, H, W] uint8 and, in a corridor, `privileged`,
        which is what lies ahead. `proprioception` [P] is an entry where it is asked for.
        """
        parts = felt(self.parts, physics, readings, action)
        if self.options.observe_place:
            parts.append(physics.qpos[:2])
        if self.options.observe_bodies:
            parts += [readings.cinert[1:].ravel(), readings.cvel[1:].ravel()]
        told = []
        if isinstance(self.parts.arena, GapsCorridor):
            farthest = self.parts.body.sight
            edges = distances_to_next_edges(task["course"], physics.qpos[0], 6, farthest)
            told = [physics.qpos[1:2], edges]
        seen = {}
        if self.limbs:
            now = body_parts.pose_of(self.limbs, physics, readings)
            seen["proprioception"] = proprioception(self.limbs, now, physics, readings, action)
        if not self.eyes:
            own = jnp.concatenate(parts + told)
            return seen | {"policy": own} if seen else own
        seen |= {"policy": jnp.concatenate(parts), "eyes": self._pictures(physics, readings, task)}
        return seen | ({"privileged": jnp.concatenate(told)} if told else {})

    def _pictures(self, physics: PhysicsState, readings: Any, task: dict) -> Array:
        """Returns what the eyes bring on, [E, H, W] uint8: this episode's whole course too."""
        assert self.eyes is not None
        boxes = None
        if "course" in task:
            boxes = platform_boxes(task["course"], self.options.corridor_width)
        given = readings, task["eyes"], physics.time, self.options.eyes
        return sight.look(self.eyes, *given, boxes=boxes)


def is_healthy(body: Body, options: Options, height: Array, up: Array, turn: Array) -> Array:
    """Tells whether the body can go on, [] bool: not fallen, thrown up, on its back or turned.

    `height` [] of the torso [m], `up` [] the z of its up-axis, `turn` [] its angle with the way
    ahead, seen from above [rad].
    """
    low, high = body.healthy_height
    if options.least_height is not None:
        low = options.least_height
    farthest = body.healthy_turn if options.healthy_turn is None else options.healthy_turn
    upright = (height > low) & (height < high) & (up > options.healthy_up)
    return upright & (turn < farthest)


def reward_terms(
    options: Options, speed: Array, distance: Array, healthy: Array, action: Array
) -> dict[str, Array]:
    """Returns the reward as its terms, [] each: speed [m/s], distance [m], health, control cost.

    The target reward is dm_control's for its corridors: linear up to the target speed, then flat.
    """
    if options.reward == "target":
        return {"target": jnp.clip(speed / options.target_speed, 0.0, 1.0)}
    return {
        "forward": options.forward_weight * speed,
        "distance": options.distance_weight * distance,
        "healthy": options.healthy_reward * healthy.astype(jnp.float32),
        "control": -options.control_weight * jnp.sum(jnp.square(action)),
    }


def build_arena(options: Options, body: Body) -> Arena:
    """Returns the arena, its window of boxes as small as the body's reach allows."""
    if options.arena not in (arenas := get_args(get_type_hints(Options)["arena"])):
        raise ValueError(f"arena is {options.arena!r}; there are {', '.join(arenas)}.")
    if options.arena == "floor":
        return Floor()
    platform_length = options.platform_length
    if options.arena == "single_gap":
        platform_length = (GapsCorridor.length, GapsCorridor.length)
    corridor = GapsCorridor(
        platform_length,
        options.gap_length,
        start_length=GapsCorridor.spawn_x + options.runway,
        width=options.corridor_width,
    )
    return dataclasses.replace(corridor, boxes=boxes_in_reach(corridor, body.reach))


def build(options: Options = Options(), engine: str = "auto") -> Run:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    body = BODIES[options.body]
    sensors = body_parts.SENSORS[options.body] if options.proprioception else ()
    parts = compose(body, build_arena(options, body), engine, sensors=sensors)
    model = parts.model
    limbs = body_parts.of_model(model, options.body) if options.proprioception else None
    readings = READINGS + (BODY_READINGS if options.observe_bodies else ())
    readings += overflow_reading(engine) + (body_parts.readings(limbs) if limbs else ())
    readings = tuple(dict.fromkeys(readings))
    window = tuple(lookup.names(model, "geom")[i] for i in parts.boxes.boxes)
    eye = seeing.of_camera(parts.looks, PREFIX + body.camera)
    return Run(
        options=options,
        physics=Physics(model, readings, options.substeps, engine),
        parts=parts,
        action_size=model.nu,
        eyes=sight.build(parts.looks, eye, body.eye_distance, options.eyes, window),
        limbs=limbs,
    )
