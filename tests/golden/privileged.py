"""A cart-pole whose value function sees more than its policy."""

from dataclasses import dataclass

import jax.numpy as jnp

from purerl import Array, Config, Evaluation, Experiment, State, networks
from purerl.envs import cartpole_swingup


@dataclass(frozen=True)
class Privileged:
    """A cart-pole whose observation is a dict; the velocities are the value function's alone."""

    env: cartpole_swingup.CartpoleSwingup
    action_size: int = 1

    @property
    def control_timestep(self) -> float:
        """That of the cart-pole [s]."""
        return self.env.control_timestep

    @property
    def physics(self):
        """That of the cart-pole."""
        return self.env.physics

    def reset(self, key: Array) -> State:
        """Starts an episode."""
        return split(self.env.reset(key))

    def step(self, state: State, action: Array) -> State:
        """Advances one control step."""
        return split(self.env.step(state.replace(observation=whole(state.observation)), action))


def split(state: State) -> State:
    seen = state.observation
    return state.replace(observation={"policy": seen[:3], "velocity": seen[3:]})


def whole(parts: dict) -> Array:
    return jnp.concatenate([parts["policy"], parts["velocity"]])


def build_env(options: cartpole_swingup.Options, engine: str) -> Privileged:
    return Privileged(cartpole_swingup.build(options, engine))


experiment = Experiment(
    build_env=build_env,
    env=cartpole_swingup.Options(),
    build_network=networks.mlp,
    network=networks.MlpOptions(
        policy_hidden=(16,), value_hidden=(16,), std="state", initial_std=0.6, min_std=1e-3
    ),
    ppo=Config.plain(
        num_steps=768,
        num_envs=16,
        rollout_length=16,
        num_epochs=2,
        num_minibatches=4,
        episode_length=20,
        learning_rate=3e-4,
        reward_scaling="return_std",
        schedule="linear",
    ),
    evaluation=Evaluation(num_episodes=4, number=1),
)
