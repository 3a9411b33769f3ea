"""An experiment's objects, built from its settings; what breaks a rule of theirs, in one line."""

import contextlib
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp

from purerl.core.env import Env, EnvError
from purerl.core.errors import RunError, UserError, one_line
from purerl.core.records import Network
from purerl.devices.check_sizes import check_minibatches
from purerl.devices.programs import abstract_state
from purerl.ppo.config import Config
from purerl.ppo.learner import is_recurrent
from purerl.runs.check_env import check_members, check_shapes
from purerl.runs.check_network import check_network
from purerl.runs.command_errors import own_line
from purerl.runs.experiment import Experiment


class Setup(NamedTuple):
    """An experiment's objects, built."""

    config: Config
    env: Env
    network: Network
    engine: str  # resolved: never "auto"


def build(chosen: Experiment) -> Setup:
    """Calls the builders; what breaks a rule, of the settings or the protocols, is a UserError."""
    # Imported here, as below: `compare` reads runs, and needs no MuJoCo.
    from purerl.physics.interface import choose_engine

    try:
        engine = choose_engine(chosen.engine)
        env = chosen.build_env(chosen.env, engine)
        check_members(env)
        with blame(env):
            state = jax.eval_shape(env.reset, jax.random.key(0))
            zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), state.observation)
        network = chosen.build_network(chosen.network, zeros, env.action_size)
        setup = Setup(chosen.ppo, env, network, engine)
        with blame(env):
            check_network(network, zeros, env.action_size)
            # Sizes that do not fit together show here, in a second.
            abstract = abstract_state(*setup[:3])
            check_minibatches(setup.config, is_recurrent(abstract.carry), setup.config.num_envs)
    except (ValueError, ImportError) as error:
        raise UserError(one_line(error)) from error
    return setup


@contextlib.contextmanager
def blame(env: Env) -> Iterator[None]:
    """Makes one line of programs that cannot be traced because the environment breaks a rule.

    The rules are looked at only then: to trace a step of the environment may take seconds.
    """
    try:
        yield
    except (UserError, RunError):
        raise
    except Exception as error:
        try:
            check_shapes(env)
        except EnvError as broken:
            what = f"{one_line(broken)}{own_line(broken.__cause__)}"
            raise UserError(f"The environment {type(env).__name__}: {what}") from error
        except Exception:
            pass  # no rule, but an error in its code, of which the first one tells more
        raise


def physics_hash(env: Env) -> str | None:
    """Returns a sha256 of the model that an environment simulates; None if it has no `physics`."""
    model = getattr(getattr(env, "physics", None), "model", None)
    if model is None:
        return None
    from purerl.physics.lookup import hash_model

    return hash_model(model)
