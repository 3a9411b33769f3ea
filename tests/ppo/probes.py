"""Probe environments: each isolates one part of PPO, so that a failure names the culprit.

After Andy Jones, "Debugging RL, without the agonizing pain" (2021). All are solved in seconds.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from purerl.core.env import State
from purerl.core.records import Array


def _state(observation: Array, reward: Array, terminated: Array, task: dict) -> State:
    return State(
        physics={},
        observation=observation.astype(jnp.float32),
        reward=reward.astype(jnp.float32),
        terminated=terminated,
        truncated=jnp.zeros((), bool),
        metrics={"reward_mean": reward.astype(jnp.float32)},
        task=task,
    )


def _sign(key: Array) -> Array:
    return jax.random.rademacher(key, (), dtype=jnp.float32)


@dataclass(frozen=True)
class Probe:
    """One observation [1] in {-1, 1} or 0, one action [1], episodes of `steps` control steps.

    `cue_steps`: the observation shows the cue before step `cue_steps`, afterwards 0.
    """

    name: str
    steps: int = 1
    cue_steps: int = 1
    control_timestep: float = 1.0
    action_size: int = 1

    def reset(self, key: Array) -> State:
        cue = _sign(key)
        zero = jnp.zeros(())
        task = {"cue": cue, "time": jnp.zeros((), jnp.int32)}
        shown = cue if self.name in CUED else zero
        return _state(shown[None], zero, jnp.zeros((), bool), task)

    def step(self, state: State, action: Array) -> State:
        time = state.task["time"] + 1
        last = time >= self.steps
        cue = state.task["cue"]
        reward = jnp.where(last, REWARDS[self.name](cue, action[0]), 0.0)
        shown = jnp.where(time < self.cue_steps, cue, 0.0) if self.name in CUED else jnp.zeros(())
        if self.name == "discounting":
            shown = time.astype(jnp.float32)
        return _state(shown[None], reward, last, state.task | {"time": time})


@dataclass(frozen=True)
class Point:
    """A point in the plane that must come to the origin, with a reward for being alive."""

    alive: float
    control_timestep: float = 1.0
    action_size: int = 2

    def reset(self, key: Array) -> State:
        return self._at(jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0))

    def step(self, state: State, action: Array) -> State:
        return self._at(state.observation + 0.1 * action)

    def _at(self, place: Array) -> State:
        reward = 1.0 - jnp.linalg.norm(place) + self.alive
        return _state(place, reward, jnp.zeros((), bool), {})


@dataclass(frozen=True)
class EngineProbe(Probe):
    """A probe that counts its steps under its engine's name."""

    engine: str = ""

    def step(self, state: State, action: Array) -> State:
        return self._count(super().step(state, action), 1.0)

    def reset(self, key: Array) -> State:
        return self._count(super().reset(key), 0.0)

    def _count(self, state: State, number: float) -> State:
        return state.replace(metrics=state.metrics | {f"{self.engine}_count": jnp.float32(number)})


def engine_probe(engine: str, *arguments: Any) -> EngineProbe:
    return EngineProbe(*arguments, engine=engine)


REWARDS = {
    "value": lambda cue, action: jnp.ones(()),
    "observation": lambda cue, action: cue,
    "discounting": lambda cue, action: jnp.ones(()),
    "policy": lambda cue, action: -jnp.square(action - 0.5),
    "both": lambda cue, action: -jnp.square(action - 0.5 * cue),
    "memory": lambda cue, action: -jnp.square(action - 0.5 * cue),
}
CUED = ("observation", "both", "memory")


@dataclass(frozen=True)
class Burst:
    """Six numbers that at some step begin to grow, by 30 in each, until their state is lost."""

    control_timestep: float = 1.0
    action_size: int = 1

    def reset(self, key: Array) -> State:
        when, values = jax.random.split(key)
        task = {"left": jax.random.randint(when, (), 5, 60)}
        return _state(jax.random.normal(values, (6,)), jnp.zeros(()), jnp.zeros((), bool), task)

    def step(self, state: State, action: Array) -> State:
        left, x = state.task["left"] - 1, state.observation
        x = jnp.where(left < 0, 30.0 * x, 0.9 * x + 0.3 * jnp.sin(7.0 * x + action))
        return _state(x, jnp.ones(()), jnp.zeros((), bool), {"left": left})
