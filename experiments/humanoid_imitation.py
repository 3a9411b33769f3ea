r"""dm_control's humanoid moves as a person did, from any frame of a recording.

python -m purerl.run humanoid_imitation
"""

import jax.numpy as jnp

from purerl import Array, Config, Evaluation, Experiment, Network, PyTree, networks
from purerl.envs import imitation
from purerl.envs.tracking import Reward, Term


def joined(observation: dict[str, Array]) -> Array:
    """Returns what a body is to do and what it feels as one array [..., O]."""
    return jnp.concatenate([observation["reference"], observation["proprioception"]], axis=-1)


def build_network(options: networks.MlpOptions, observation: PyTree, action_size: int) -> Network:
    """Builds the default network, whose policy and value function read all of the observation."""
    network = networks.mlp(options, joined(observation), action_size)

    def apply(params: PyTree, observation: PyTree, memory: PyTree) -> tuple:
        return network.apply(params, joined(observation), memory)

    return network._replace(apply=apply)


experiment = Experiment(
    build_env=imitation.build,
    env=imitation.Options(
        body="humanoid",
        clips="squats",
        control_rate=50,
        substeps=4,
        farthest_place=0.3,
        farthest_turn=60.0,
        # Servos hold a pose: what an action costs is how far it jumps.
        reward=Reward(
            root_position=Term(1.0, 0.1),
            root_rotation=Term(1.0, 20.0),
            joints=Term(1.0, 2.0),
            end_effectors=Term(1.0, 0.2),
            height_weight=0.0,
            control_weight=0.0,
            change_weight=0.002,
            energy_weight=0.0,
        ),
    ),
    build_network=build_network,
    network=networks.MlpOptions(
        policy_hidden=(256, 256), value_hidden=(256, 256), initial_std=0.5, min_std=1e-3
    ),
    ppo=Config(
        num_steps=1_200_000,
        # An action of 0 is the middle of each joint's range, far from a stance. How far the policy
        # moves in an update is limited, in its own scale: so small updates, and a large scale.
        rollout_length=32,
        num_minibatches=4,
        gamma=0.95,
        episode_length=250,  # 5 s
        learning_rate=3e-4,
        entropy_weight=0.0,
    ),
    evaluation=Evaluation(num_episodes=64, number=10),
)
