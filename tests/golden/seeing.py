"""A cart-pole that is not told where it is: it sees, and remembers."""

from dataclasses import dataclass

import jax.numpy as jnp

from purerl import Array, Evaluation, Experiment, State, eyes
from purerl.envs import cartpole_swingup
from tests.golden import recurrent


@dataclass(frozen=True)
class Seen:
    """A cart-pole whose policy knows its speeds, and sees the rest from before the rail."""

    env: cartpole_swingup.CartpoleSwingup
    eyes: eyes.Eyes
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
        return self.see(self.env.reset(key))

    def step(self, state: State, action: Array) -> State:
        """Advances one control step."""
        return self.see(self.env.step(state, action))

    def see(self, state: State) -> State:
        """Gives a state its picture: where the world, the cart and the pole are, worked by hand."""
        position, angle = state.physics.qpos
        place = jnp.zeros((3, 3)).at[1:, 0].set(position)
        sine, cosine = jnp.sin(angle), jnp.cos(angle)
        turn = jnp.tile(jnp.eye(3), (3, 1, 1))
        turn = turn.at[2, ::2, ::2].set(jnp.array([[cosine, sine], [-sine, cosine]]))
        picture = self.eyes.see(place, turn)
        return state.replace(observation={"policy": state.physics.qvel, "eyes": picture})


def build_env(options: cartpole_swingup.Options, engine: str) -> Seen:
    env = cartpole_swingup.build(options, engine)
    eye = eyes.of_camera(env.physics.model, "front")
    return Seen(env, eyes.Eyes(env.physics.model, [eye], (16, 16), reach=6.0))


experiment = Experiment(
    build_env=build_env,
    env=cartpole_swingup.Options(),
    build_network=eyes.recurrent,
    network=eyes.RecurrentOptions(
        cell="gru",
        hidden=8,
        encoder=(8,),
        policy_hidden=(8,),
        value_hidden=(8,),
        eyes=eyes.Encoder((4,), (4,), (4,), 8),
    ),
    ppo=recurrent.experiment.ppo,
    evaluation=Evaluation(num_episodes=4, number=1),
)
