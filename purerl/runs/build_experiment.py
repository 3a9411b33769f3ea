"""An experiment's objects, built from its settings; what breaks a rule of theirs, in one line."""

import contextlib
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp

from purerl.core.env import Env, EnvError
from purerl.core.errors import RunError, UserError, one_line
from purerl.core.records import Network, PolicyOutput, PyTree
from purerl.devices.check_sizes import check_minibatches
from purerl.devices.programs import abstract_state
from purerl.ppo.config import Config
from purerl.ppo.learner import is_recurrent
from purerl.runs.check_env import check_fields, check_members, check_shapes
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
            check_fields(state)
            zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), state.observation)
        network = chosen.build_network(chosen.network, zeros, env.action_size)
        setup = Setup(chosen.ppo, env, network, engine)
        with blame(env):
            _check_network(network, zeros, env.action_size)
            # Sizes that do not fit together show here, in a second.
            abstract = abstract_state(*setup[:3])
            check_minibatches(setup.config, is_recurrent(abstract.carry), setup.config.num_envs)
    except (ValueError, ImportError) as error:
        raise UserError(one_line(error)) from error
    return setup


def _check_network(network: Network, observation: PyTree, action_size: int) -> None:
    """Raises ValueError unless a network's answers have the shapes that the trainer reads."""
    params, carry = jax.eval_shape(network.init, jax.random.key(0))
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            raise ValueError(
                f"The network's parameter {jax.tree_util.keystr(path)} is {leaf.dtype}: parameters "
                "are trained, so they are floating-point numbers. Keep constants in the closure of "
                "`apply`."
            )
    batch = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct((2, *x.shape), x.dtype), (observation, carry)
    )
    output, following = jax.eval_shape(network.apply, params, *batch)
    if not isinstance(output, PolicyOutput):
        raise ValueError(
            f"The network's `apply` returned a {type(output).__name__} and a memory; it must be "
            "a purerl.PolicyOutput and the memory."
        )
    scalar, action = (2,), (2, action_size)
    normal = output.distribution
    answers = [("loc", normal.loc, action), ("scale", normal.scale, action)]
    for name, answer, shape in [*answers, ("value", output.value, scalar)]:
        if answer.shape != shape:
            raise ValueError(
                f"The network's {name} is {list(answer.shape)} for 2 observations and "
                f"{action_size} actions; it must be {list(shape)}."
            )
    kinds = [jax.tree.map(lambda x: (x.shape, x.dtype), tree) for tree in (batch[1], following)]
    if kinds[0] != kinds[1]:
        raise ValueError(
            f"The network's memory goes in as {kinds[0]} and comes back as {kinds[1]}, for 2 "
            "environments; `apply` must return it as it was given, and `init` one environment's."
        )


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


def own_line(error: BaseException | None) -> str:
    """Returns " (FILE, line N)": the last line of the user's own code on the way to an error.

    Code of this library and of installed packages is not the user's. "" if no line is.
    """
    frames = traceback.extract_tb(error.__traceback__ if error else None)
    others = ("site-packages", "dist-packages", str(Path(__file__).parent.parent))
    own = [frame for frame in frames if not any(other in frame.filename for other in others)]
    return f" ({own[-1].filename}, line {own[-1].lineno})" if own else ""


def physics_hash(env: Env) -> str | None:
    """Returns a sha256 of the model that an environment simulates; None if it has no `physics`."""
    model = getattr(getattr(env, "physics", None), "model", None)
    if model is None:
        return None
    from purerl.physics.lookup import hash_model

    return hash_model(model)
