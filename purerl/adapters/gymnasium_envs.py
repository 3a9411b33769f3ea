"""An environment of Gymnasium in our trainer, stepped through the host.

Such an environment is an object that changes, and no pure function: our state has only the seed of
its episode and the number of steps since, and a pool on the host keeps the object that has come so
far. So a process that resumes a run cannot go on with its episodes: they count as lost, and begin
anew. The run's plan says so.
"""

import functools
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from purerl.adapters.foreign import Drawn, float32
from purerl.core.env import State
from purerl.core.errors import one_line
from purerl.core.records import Array
from purerl.physics.interface import PhysicsState

_DRAWN = ("qpos", "qvel", "act", "qacc_warmstart", "mocap_pos", "mocap_quat")
_INEXACT = "the environment keeps state of its own: a resumed run begins its episodes anew, as lost"
_RATE = 20  # steps of a simulated second, where an environment does not say


@dataclass(frozen=True)
class GymnasiumOptions:
    """Which of Gymnasium's environments."""

    name: str = "HalfCheetah-v5"
    """As Gymnasium calls it: HalfCheetah-v5, Pendulum-v1, ..."""


def from_gymnasium(
    options: GymnasiumOptions = GymnasiumOptions(),  # noqa: B008
    engine: str = "auto",
) -> "HostEnv":
    """Builds an environment; `build_env` of an experiment whose `env` is `GymnasiumOptions`.

    Args:
      options: which one. Its time limit is not used: set `ppo.episode_length`.
      engine: not heeded, since the environment brings its physics.

    Raises:
      ValueError: Gymnasium has none of that name, or its spaces are not those of `from_maker`.
    """
    try:
        gymnasium.spec(options.name)
    except gymnasium.error.Error as error:  # it names what is near, or what is not imported
        what = f"There is no environment of Gymnasium {options.name!r}"
        raise ValueError(f"{what}: {one_line(error)}") from error
    return from_maker(lambda: gymnasium.make(options.name, max_episode_steps=-1))


def from_maker(make: Callable[[], gymnasium.Env]) -> "HostEnv":
    """Returns any environment of Gymnasium as ours: `build_env` can end with it.

    Our actions in [-1, 1] become its own between its limits; for a Box of integers, the nearest.

    Args:
      make: makes one. As many are made as episodes run at once.

    Raises:
      ValueError: its actions are no vector of numbers within limits, or what it observes is not
        made of numbers.
    """
    pool = _Pool(make)
    space, bare = pool.example.action_space, pool.example.unwrapped
    if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
        raise ValueError(f"Its actions are {space}; here they are a vector: a Box of one axis.")
    if not np.isfinite([space.low, space.high]).all():
        raise ValueError(f"Its actions are {space}; [-1, 1] is mapped to limits: they are finite.")
    if not pool.example.observation_space.is_np_flattenable:
        raise ValueError(f"It observes {pool.example.observation_space}: no vector of numbers.")
    seconds = float(getattr(bare, "dt", 0) or 1 / (bare.metadata.get("render_fps") or _RATE))
    model = getattr(bare, "model", None)
    drawn = Drawn(model) if isinstance(model, mujoco.MjModel) else None
    return HostEnv(pool, drawn, space.shape[0], seconds)


@dataclass(frozen=True)
class HostEnv:
    """Gymnasium's environment behind our protocol."""

    pool: "_Pool"
    physics: Drawn | None
    action_size: int
    control_timestep: float  # [s]
    inexact: str = _INEXACT

    def reset(self, key: Array) -> State:
        """Starts an episode."""
        seed = jax.random.bits(key, (2,), jnp.uint32)
        return self._call(self.pool.reset, seed, jnp.zeros((), jnp.int32))

    def step(self, state: State, action: Array) -> State:
        """Advances one control step; action [A] in [-1, 1]."""
        seed, steps = state.task
        return self._call(self.pool.step, seed, steps + 1, action)

    def _call(self, function: Callable[..., np.ndarray], seed: Array, *rest: Array) -> State:
        shape = jax.ShapeDtypeStruct((self.pool.width,), np.float32)
        row = jax.pure_callback(function, shape, seed, *rest, vmap_method="broadcast_all")
        task = (seed, jnp.asarray(rest[0], jnp.int32))
        reward, terminated, truncated = row[0], row[1] > 0.5, row[2] > 0.5
        end = 3 + self.pool.observed
        parts, at = {}, end
        for name, shape in self.pool.drawn.items():
            size = int(np.prod(shape))
            parts[name], at = row[at : at + size].reshape(shape), at + size
        time = float32(task[1]) * self.control_timestep
        return State(
            physics=PhysicsState(time=time, **parts) if parts else (),
            observation=row[3:end],
            reward=reward,
            terminated=terminated,
            truncated=truncated & ~terminated,
            metrics={},
            task=task,
        )


@dataclass
class _Episode:
    env: gymnasium.Env
    steps: int = 0
    action: bytes = b""  # the last one
    row: Any = None  # what that brought, [width]
    over: bool = False


def warned_once(make: Callable[[], gymnasium.Env]) -> Callable[[], gymnasium.Env]:
    """Returns `make`, of which MuJoCo says each warning once: each episode compiles its XML."""

    @functools.cache
    def tell(text: str) -> None:
        print(f"MuJoCo: {text.strip()}", file=sys.stderr)

    def made() -> gymnasium.Env:
        mujoco.set_mju_user_warning(tell)
        try:
            return make()
        finally:
            mujoco.set_mju_user_warning(None)

    return made


class _Pool:
    """The objects whose episodes run, by the seed of the episode."""

    def __init__(self, make: Callable[[], gymnasium.Env]) -> None:
        self.make = warned_once(make)
        self.example = self.make()
        space: Any = self.example.action_space
        self.low, self.high = getattr(space, "low", 0), getattr(space, "high", 0)
        self.episodes: OrderedDict[tuple[int, ...], _Episode] = OrderedDict()
        self.sizes: set[int] = set()  # how many were stepped together, in each program
        self.lock = threading.Lock()  # XLA calls from any of its threads
        observation, _ = self.example.reset(seed=0)
        self.observed = len(self._flat(observation))
        data = getattr(self.example.unwrapped, "data", None)
        is_mujoco = isinstance(data, mujoco.MjData)
        self.drawn = {name: getattr(data, name).shape for name in _DRAWN} if is_mujoco else {}
        self.width = len(self._row(self.example, observation, 0.0, False, False))

    def reset(self, seeds: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """Returns what episodes begin with: seeds [..., 2], zeros [...] to rows [..., width]."""
        with self.lock:
            rows = [self._begin(self.example, seed) for seed in np.reshape(seeds, (-1, 2))]
        return np.reshape(rows, (*np.shape(steps), self.width))

    def step(self, seeds: np.ndarray, steps: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Takes a step in each episode: seeds [..., 2], which step [...], actions [..., A]."""
        shape, actions = np.shape(steps), np.asarray(actions, np.float32)
        with self.lock:
            self.sizes.add(max(1, int(np.prod(shape))))
            flat = actions.reshape(-1, actions.shape[-1])
            rows = list(map(self._step, np.reshape(seeds, (-1, 2)), np.ravel(steps), flat))
            # Episodes that the trainer has left: those of each program may rest for a while.
            while len(self.episodes) > 2 * sum(self.sizes):
                self.episodes.popitem(last=False)[1].env.close()
        return np.reshape(rows, (*shape, self.width))

    def _step(self, seed: np.ndarray, step: int, action: np.ndarray) -> np.ndarray:
        name = tuple(map(int, seed))
        episode = self.episodes.get(name)
        begun = episode and episode.action == action.tobytes() and episode.steps <= 1
        if step == 1 and not begun:
            episode = self.episodes[name] = _Episode(episode.env if episode else self.make())
            self._begin(episode.env, seed)
        if episode is None:  # of another process
            return np.full(self.width, np.nan, np.float32)
        self.episodes.move_to_end(name)
        if episode.over or (episode.steps, episode.action) == (step, action.tobytes()):
            return episode.row
        if episode.steps != step - 1:  # of the past
            return np.full(self.width, np.nan, np.float32)
        scaled = self.low + (np.clip(action, -1, 1) + 1) / 2 * (self.high - self.low)
        kind = self.example.action_space.dtype
        scaled = np.rint(scaled) if np.issubdtype(kind, np.integer) else scaled
        *found, _ = episode.env.step(scaled.astype(kind))
        episode.row = self._row(episode.env, *found)
        episode.steps, episode.action = int(step), action.tobytes()
        episode.over = bool(found[2] or found[3])
        return episode.row

    def _begin(self, env: gymnasium.Env, seed: np.ndarray) -> np.ndarray:
        # 32 bits: more are none of `np.random.RandomState`, which many environments still seed.
        (number,) = np.random.SeedSequence([int(part) for part in seed]).generate_state(1)
        observation, _ = env.reset(seed=int(number))
        return self._row(env, observation, 0.0, False, False)

    def _row(self, env: gymnasium.Env, observation: Any, *said: Any) -> np.ndarray:
        """Returns reward, whether it terminated and was truncated, `said`, and what is seen."""
        data = getattr(env.unwrapped, "data", None)
        parts = [np.ravel(getattr(data, name)) for name in self.drawn]
        return np.concatenate([said, self._flat(observation), *parts], dtype=np.float32)

    def _flat(self, observation: Any) -> np.ndarray:
        space = self.example.observation_space
        return np.asarray(gymnasium.spaces.flatten(space, observation), np.float32)
