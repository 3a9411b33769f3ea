"""What an experiment is: builder functions, and the data that they are called with.

Nothing heavy is imported here, so that a list of experiments or a help page comes at once.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from purerl.core.errors import check_least
from purerl.experiment.options import Engine
from purerl.ppo.config import Config, Evaluation

if TYPE_CHECKING:
    from purerl.core.env import Env
    from purerl.core.records import Network, PyTree
else:  # the annotations are evaluated, to check settings, and these would import JAX
    Env = Network = PyTree = Any


@dataclass(frozen=True)
class Part:
    """A part of the network: a subtree of its parameters, which learns or begins in its own way."""

    rate: float = 1.0
    """Factor on the learning rate of its parameters; 0: frozen."""
    run: str = ""
    """Run that it begins as: a folder, or a policy of purerl's, such as ant_gaps; empty: drawn."""
    checkpoint: str = "latest"
    """Of that run: latest, best (highest evaluation return), or an update's number."""
    reads: tuple[str, ...] | None = None
    """Entries of the observation that it reads ("policy" where that is an array): their mean and
    deviation are taken from that run too, and stay as they are. Where that run's observation is an
    array and this one's a dict, the array is cut into these entries, in this order."""

    def __post_init__(self) -> None:
        """Raises ValueError for a rate that is none, and for units that nobody has chosen."""
        check_least(self, ValueError, rate=0)
        if isinstance(self.reads, str):
            raise ValueError(f"reads is {self.reads!r}; give a tuple of names: ({self.reads!r},).")
        if bool(self.run) != (self.reads is not None):
            raise ValueError(
                f"run is {self.run!r} and reads is {self.reads}; a part of another run needs both: "
                'in reads the entries of the observation that it reads, such as ("policy",), or ().'
            )


@dataclass(frozen=True)
class Experiment:
    """What is trained and how: builders (functions) and settings (frozen dataclasses).

    `build_env(env, engine) -> Env` and `build_network(network, observation, action_size) ->
    Network`, where `observation` is one environment's, zeros of the right shapes. Every setting can
    be overridden on the command line: `--ppo.learning-rate 1e-3 --env.forward-weight 2`.
    """

    build_env: Callable[[Any, str], Env]
    env: Any
    build_network: Callable[[Any, PyTree, int], Network]
    network: Any
    ppo: Config
    seed: Annotated[int, tyro.conf.arg(help="Seed of everything random in the run.")] = 1
    engine: Annotated[
        Engine,
        tyro.conf.arg(
            help="Physics engine; auto: c (MuJoCo's C code) where JAX is on a CPU, else jax (MJX)."
        ),
    ] = "auto"
    evaluation: Evaluation = Evaluation()
    parts: dict[str, Part] = field(default_factory=dict)  # name of a subtree of parameters -> how


BUILDERS = ("build_env", "build_network")


def shrunk(experiment: Experiment) -> Experiment:
    """Returns an experiment of tiny sizes, to see within a minute that every part of it runs."""
    length = min(experiment.ppo.episode_length, 32)
    ppo = replace(
        experiment.ppo, num_steps=1024, num_envs=8, rollout_length=32, num_epochs=1,
        num_minibatches=2, episode_length=length,
    )  # fmt: skip
    number = min(experiment.evaluation.number, 1)
    evaluation = replace(experiment.evaluation, num_episodes=2, number=number)
    return replace(experiment, ppo=ppo, evaluation=evaluation)
