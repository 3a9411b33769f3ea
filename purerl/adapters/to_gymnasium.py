"""Our environments as `gymnasium.Env` and `gymnasium.vector.VectorEnv`."""

from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from purerl.adapters.stepping import check_length, example, sound_step, to_numpy
from purerl.core.env import Env, State
from purerl.core.errors import UserError
from purerl.core.records import Array
from purerl.physics.drawing import take_picture
from purerl.ppo.episodes import select
from purerl.report.renderer import Renderer, model_of

Begun = tuple[Any, dict[str, Any]]  # what was observed, and the information beside it


def spaces(env: Env) -> tuple[gymnasium.Space, gymnasium.Space]:
    """Returns the spaces of one observation (a Box, or a Dict of them) and one action."""

    def box(x: Any) -> gymnasium.Space:
        return gymnasium.spaces.Box(-np.inf, np.inf, x.shape, np.float32)

    seen = example(env).observation
    parts = {k: box(x) for k, x in seen.items()} if isinstance(seen, dict) else None
    action = gymnasium.spaces.Box(-1.0, 1.0, (env.action_size,), np.float32)
    return gymnasium.spaces.Dict(parts) if parts else box(seen), action


def new_key(rng: np.random.Generator) -> Array:
    """Returns a JAX key drawn from Gymnasium's generator."""
    return jax.random.key(int(rng.integers(2**32)))


def begun(env: Any) -> State:
    """Returns the state of an environment that was reset; ResetNeeded if it was not."""
    if not hasattr(env, "state"):
        raise gymnasium.error.ResetNeeded("Call reset() first: there is no episode yet.")
    return env.state


class GymnasiumEnv(gymnasium.Env):
    """One of our environments as a `gymnasium.Env`."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}

    def __init__(
        self, env: Env, episode_length: int = 1000, render_mode: str | None = None
    ) -> None:
        """Compiles nothing yet.

        Args:
          env: the environment.
          episode_length: control steps until it is truncated.
          render_mode: None or "rgb_array".

        Raises:
          UserError: no steps, or nothing to draw.
          RunError: there is no OpenGL to draw with.
        """
        self.env, self.episode_length = env, check_length(episode_length)
        self.observation_space, self.action_space = spaces(env)
        self.metadata = self.metadata | {"render_fps": round(1 / env.control_timestep)}
        self.render_mode = render_mode
        self.renderer = Renderer(model_of(env), 640, 480) if render_mode else None
        self._take = jax.jit(lambda state: take_picture(env, state))
        self._reset, self._step = jax.jit(env.reset), jax.jit(sound_step(env))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> Begun:
        """Starts an episode; the same seed starts the same."""
        super().reset(seed=seed)
        self.state, self.steps = self._reset(new_key(self.np_random)), 0
        if self.renderer:
            self.renderer.stage.begin_episode()
        return to_numpy(self.state.observation), _info(self.state)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advances one control step; action [A] in [-1, 1]."""
        state, lost = self._step(begun(self), np.asarray(action, np.float32))
        self.state, self.steps = state, self.steps + 1
        terminated = bool(state.terminated)
        truncated = bool(state.truncated) or (self.steps >= self.episode_length and not terminated)
        info = _info(state) | {"lost": bool(lost)}
        return to_numpy(state.observation), float(state.reward), terminated, truncated, info

    def render(self) -> Any:
        """Returns the picture, uint8 [H, W, 3]; None without a render mode."""
        return self.renderer and self.renderer.draw(jax.device_get(self._take(begun(self))))

    def close(self) -> None:
        """Frees what OpenGL holds."""
        if self.renderer:
            self.renderer.__exit__()
        self.renderer = None


def _info(state: State) -> dict[str, Any]:
    return {name: float(x) for name, x in state.metrics.items()}


gymnasium_env = GymnasiumEnv


class GymnasiumVectorEnv(VectorEnv):
    """Our environments as a `gymnasium.vector.VectorEnv`, stepped together by one program."""

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(self, env: Env, number: int, episode_length: int = 1000) -> None:
        """Compiles nothing yet.

        Args:
          env: the environment.
          number: B.
          episode_length: control steps until one is truncated.
        """
        self.num_envs, self.episode_length = number, check_length(episode_length)
        self.single_observation_space, self.single_action_space = spaces(env)
        self.observation_space = batch_space(self.single_observation_space, number)
        self.action_space = batch_space(self.single_action_space, number)
        self.steps, self.over = np.zeros(number, int), np.zeros(number, bool)
        self._start = jax.jit(jax.vmap(env.reset))
        self._step = jax.jit(jax.vmap(sound_step(env)))
        self._choose = jax.jit(select)

    def reset(self, *, seed: Any = None, options: dict | None = None) -> Begun:
        """Starts all episodes, or some.

        Args:
          seed: a number; or a list of B, None among them: each starts as a `GymnasiumEnv` does.
          options: "reset_mask", [B] bool: which episodes start; none: all.

        Raises:
          UserError: a list or a mask of another length.
        """
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        for name, given in {"seed": seed, "reset_mask": mask}.items():
            if np.ndim(given) and len(given) != self.num_envs:
                raise UserError(f"{name} has {len(given)} entries for {self.num_envs} episodes.")
        fresh = self._start(self._keys(seed))
        self.state = fresh if mask.all() else self._choose(mask, fresh, begun(self))
        self.steps, self.over = np.where(mask, 0, self.steps), self.over & ~mask
        infos = to_numpy(self.state.metrics) | {"lost": np.zeros(self.num_envs, bool)}
        return to_numpy(self.state.observation), infos

    def _keys(self, seed: Any = None) -> Array:
        """Returns a key [B] for each environment's start."""
        if np.ndim(seed) == 0:
            super().reset(seed=seed)
            return jax.random.split(new_key(self.np_random), self.num_envs)
        drawn = [self.np_random if one is None else seeding.np_random(one)[0] for one in seed]
        return jax.vmap(jax.random.key)(np.array([x.integers(2**32) for x in drawn], np.uint32))

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advances all [B]; those that ended in the step before begin anew, and are not stepped."""
        new = self.over
        stepped, lost = self._step(begun(self), np.asarray(actions, np.float32))
        if new.any():
            stepped = self._choose(new, self._start(self._keys()), stepped)
        self.state = stepped
        self.steps = np.where(new, 0, self.steps + 1)
        terminated, late = np.array(stepped.terminated), self.steps >= self.episode_length
        truncated = (np.array(stepped.truncated) | late) & ~terminated
        self.over = terminated | truncated
        reward = np.where(new, 0.0, np.asarray(stepped.reward))
        infos = to_numpy(stepped.metrics) | {"lost": np.asarray(lost) & ~new}
        return to_numpy(stepped.observation), reward, terminated, truncated, infos


gymnasium_vector_env = GymnasiumVectorEnv
