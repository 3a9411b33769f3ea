"""An experiment's objects, built from its settings; what breaks a rule of theirs, in one line."""

import contextlib
import inspect
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from purerl.checks import check_env, check_traces
from purerl.checks.user_code import check_takes, users_errors
from purerl.core.env import Env, EnvError
from purerl.core.errors import RunError, UserError, one_line
from purerl.core.records import Network, PolicyOutput, PyTree
from purerl.devices import memory, programs, threads
from purerl.devices.check_sizes import check_minibatches
from purerl.experiment import settings_json
from purerl.experiment.definition import Experiment, Part
from purerl.experiment.kinds import wrong_value
from purerl.experiment.network_parts import with_parts
from purerl.physics import interface, lookup
from purerl.ppo import episodes, networks
from purerl.ppo.config import Config
from purerl.ppo.learner import is_recurrent

PARTS = "docs/howto/network_parts.md"


class Setup(NamedTuple):
    """An experiment's objects, built."""

    config: Config
    env: Env
    network: Network
    engine: str  # resolved: never "auto"


def build(chosen: Experiment) -> Setup:
    """Calls the builders; what breaks a rule, of the settings or the protocols, is a UserError."""
    _check_jax()
    if wrong := wrong_value(chosen):
        raise UserError(f"The experiment's {wrong}")
    check_takes("build_env", chosen.build_env, "options", "engine")
    check_takes("build_network", chosen.build_network, "options", "observation", "action_size")
    threads.leave_one(chosen.engine)
    with users_errors(""):
        engine = interface.choose_engine(chosen.engine)
    with users_errors("build_env: "):
        env = chosen.build_env(chosen.env, engine)
    if env is None:
        raise UserError("build_env returned None: its last line must return the environment.")
    about = f"The environment {type(env).__name__}: "
    with users_errors(""):
        check_env.check_members(env)
    with users_errors(about):
        state = check_env.shapes_of_reset(env)
        check_env.check_fields(state)
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), state.observation)
    with users_errors("build_network: "):
        network = chosen.build_network(chosen.network, zeros, env.action_size)
    with users_errors(""):
        params, output = _check_network(network, zeros, env.action_size)
        _check_weights(chosen.ppo.auxiliary, output.losses)
        network = with_parts(in_float32(network), chosen.parts, params, zeros)
    setup = Setup(chosen.ppo, env, network, engine)
    with users_errors(""), naming_broken_rules(env):
        # Sizes that do not fit together show here, in a second.
        abstract = programs.abstract_state(*setup[:3])
        check_minibatches(setup.config, is_recurrent(abstract.memory), setup.config.num_envs)
    return setup


def check_acts(chosen: Experiment, before: dict[str, Any], env: Env, abstract: PyTree) -> None:
    """Raises UserError for changed settings of a run that goes on, which only its beginning reads.

    They are the seed, which is in the state as a key; the rate that an adaptive schedule starts at;
    and what leaves a network's `apply` as it was. All of an environment is in every update.

    Args:
      chosen: the experiment as its run shall go on.
      before: the settings that the run had, as JSON values.
      env: the environment.
      abstract: shapes of the run's state.
    """
    seen = abstract.env_state.observation
    example = jax.tree.map(lambda x: jnp.zeros(x.shape[1:], x.dtype), seen)

    def trace(settings: Any) -> Any:
        options = settings_json.from_json(chosen.network, settings)
        network = chosen.build_network(options, example, env.action_size)
        more = episodes.draw(network, jax.random.key(0), jnp.arange(len(abstract.env_ids)))
        return check_traces.trace_anew(network.apply, abstract.params, seen, abstract.memory, *more)

    now, old = settings_json.to_json(chosen.network), before["network"]
    idle = ["seed"] * (before["seed"] != chosen.seed)
    if chosen.ppo.schedule == "adaptive_kl":
        idle += ["ppo.learning_rate"] * (before["ppo"]["learning_rate"] != chosen.ppo.learning_rate)
    then, drawn = before.get("parts", {}), settings_json.to_json(Part())
    for name, part in settings_json.to_json(chosen.parts).items():
        # A rate is in every update.
        idle += [f"parts.{name}"] * (then.get(name, drawn) | {"rate": part["rate"]} != part)
    for name in now if isinstance(now, dict) and isinstance(old, dict) else ():
        if old.get(name, now[name]) != now[name]:
            with contextlib.suppress(Exception):  # the code of today refuses what was: it acts
                if check_traces.difference(trace(now | {name: old[name]}), trace(now)) is None:
                    idle.append(f"network.{name}")
    if idle:
        raise UserError(
            f"{', '.join(idle)}: read only when a run begins; give what it was, or another --name."
        )


def check_observation(env: Env, learned: PyTree) -> None:
    """Raises UserError unless an environment's observation has the shapes that were learned from.

    Args:
      env: the environment, of other settings.
      learned: an observation of the environment that a policy was trained in, or its shapes.
    """
    other = jax.eval_shape(env.reset, jax.random.key(0)).observation
    given, wanted = (jax.tree.map(lambda x: list(x.shape), tree) for tree in (other, learned))
    if given != wanted:
        raise UserError(
            f"These options make an observation {given}, and the policy was trained on {wanted}: "
            "take them back, or train with them."
        )


def check_memory(setup: Setup, abstract: PyTree, seeds: int, devices: int) -> None:
    """Raises UserError, with the size to lower, if a run cannot fit into a device's memory.

    Args:
      setup: the experiment's objects.
      abstract: shapes of one seed's state.
      seeds: how many share the program.
      devices: how many share the environments.
    """
    parts = memory.least(setup.config, abstract, setup.env.action_size)
    with users_errors(""):
        memory.check_room({k: x * seeds // devices for k, x in parts.items()}, memory.room())


def _check_jax() -> None:
    if jax.config.jax_disable_jit:  # type: ignore[attr-defined]
        raise UserError("JAX_DISABLE_JIT is on, and a run is compiled programs: unset it.")
    if jax.config.read("jax_enable_x64"):
        raise UserError(
            "JAX_ENABLE_X64 is on, which makes numbers float64; a run computes in float32: unset "
            'it, or call jax.config.update("jax_enable_x64", False).'
        )


def _check_weights(weights: dict[str, Any], named: dict[str, Any]) -> None:
    """Raises ValueError unless each loss that the network names has a weight, and no other."""
    if weights.keys() != named.keys():
        losses, weighed = (", ".join(sorted(names)) or "none" for names in (named, weights))
        raise ValueError(
            f"The network returns the losses: {losses}; ppo.auxiliary weighs: {weighed}. Give each "
            "loss a weight, which may be 0, and take away those of no loss."
        )
    for name, weight in weights.items():
        *ends, steps = weight if isinstance(weight, list | tuple) else (weight, 1)
        if not (all(map(math.isfinite, ends)) and 1 <= steps < math.inf):
            raise ValueError(
                f"ppo.auxiliary.{name} is {weight}: give a finite number, or the first, the last "
                "and in how many steps, 1 or more."
            )


def _check_network(network: Network, observation: PyTree, action_size: int) -> tuple[Any, Any]:
    """Returns shapes of parameters and answers; ValueError unless the trainer can read them."""
    if not isinstance(network, Network):
        raise ValueError(
            f"build_network returned a {type(network).__name__}; it must return a "
            "purerl.Network(init, apply). Of a Flax module, networks.from_linen makes one."
        )
    check_takes("network.init", network.init, "key")
    params, carry = _pair("init(key)", "parameters", network.init, jax.random.key(0))
    given = _taken(network, carry)
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            raise ValueError(
                f"The network's parameter {jax.tree_util.keystr(path)} is {leaf.dtype}: parameters "
                "are trained, so they are floating-point numbers. Keep constants in the closure of "
                "`apply`."
            )
    _check_memory_starts_at_zero(network, carry)
    two = jax.tree.map(lambda x: jax.ShapeDtypeStruct((2, *x.shape), x.dtype), (observation, carry))
    drawn = episodes.draw(network, jax.random.key(0), jnp.arange(2))
    said = f"apply({', '.join(given)})"
    output, following = _pair(said, "a purerl.PolicyOutput", network.apply, params, *two, *drawn)
    if not isinstance(output, PolicyOutput):
        raise ValueError(
            f"The network's `apply` returned a {type(output).__name__} and a memory; it must be "
            "a purerl.PolicyOutput and the memory."
        )
    scalar, action = (2,), (2, action_size)
    normal = output.distribution
    losses = [(f"loss {name}", x, scalar) for name, x in output.losses.items()]
    answers = [("loc", normal.loc, action), ("scale", normal.scale, action)]
    for name, answer, shape in [*answers, ("value", output.value, scalar), *losses]:
        if not jnp.issubdtype(answer.dtype, jnp.floating):
            raise ValueError(f"The network's {name} is {answer.dtype}; it must be float32.")
        if answer.shape != shape:
            raise ValueError(
                f"The network's {name} is {list(answer.shape)} for 2 observations and "
                f"{action_size} actions; it must be {list(shape)}."
            )
    kinds = [jax.tree.map(lambda x: (x.shape, x.dtype), tree) for tree in (two[1], following)]
    if kinds[0] != kinds[1]:
        raise ValueError(
            f"The network's memory goes in as {kinds[0]} and comes back as {kinds[1]}, for 2 "
            "environments; `apply` must return it as it was given, and `init` one environment's."
        )
    return params, output


def _taken(network: Network, carry: PyTree) -> list[str]:
    """Returns what `apply` is called with; UserError unless it takes noise just if it is drawn."""
    noise = ["noise"] * (network.draw is not None)
    given = ["params", "observation", "memory", *noise]
    name, function, taken = "network.apply", network.apply, given
    if getattr(function, "__module__", "") == networks.__name__:  # the module says more
        module = inspect.getclosurevars(function).nonlocals["module"]
        name, function = type(module).__name__, module.__call__
        taken = ["observation", *["memory"] * bool(jax.tree.leaves(carry)), *noise]
    cure = f" Let it take what Network.draw draws, as noise=None, or leave draw out ({PARTS})."
    check_takes(name, function, *taken, cure=cure * len(noise))
    more = list(inspect.signature(function).parameters.values())[len(taken) :]
    if not noise and more and more[0].default is None and more[0].kind < more[0].KEYWORD_ONLY:
        told = f"{name} takes {more[0].name}, and there is no Network.draw to draw it"
        raise UserError(f"{told}: give one ({PARTS}), or, if it is no noise, put * before it.")
    return given


def in_float32(network: Network) -> Network:
    """Returns a network whose answers are float32, as all that is computed with them.

    It may compute in half precision; its memory keeps the dtype that it has.
    """

    def apply(params: PyTree, *given: PyTree, **more: Any) -> tuple[PolicyOutput, PyTree]:
        output, memory = network.apply(params, *given, **more)
        return jax.tree.map(lambda x: x.astype(jnp.float32), output), memory

    vars(apply)["sequences"] = getattr(network.apply, "sequences", False)
    return network._replace(apply=apply)


def _check_memory_starts_at_zero(network: Network, carry: PyTree) -> None:
    """Raises ValueError unless `init` gives a memory of zeros, with which every episode starts."""
    if jax.tree.leaves(carry):
        memory = jax.jit(lambda key: network.init(key)[1])(jax.random.key(0))
        if any(jnp.any(x) for x in jax.tree.leaves(memory)):
            raise ValueError(
                "The network's memory starts as other numbers than 0, and every episode starts "
                "with zeros: return zeros from `init`, and add the rest in `apply`."
            )


def _pair(call: str, first: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Returns the shapes of what a network's function returns: two things, the second a memory."""
    with users_errors(f"The network's {call}: "):
        found = jax.eval_shape(function, *arguments)
    if type(found) is not tuple or len(found) != 2:
        raise ValueError(
            f"The network's {call} returned a {type(found).__name__}; it must return {first} and "
            "the memory, which is () of a network without one."
        )
    return found


@contextlib.contextmanager
def naming_broken_rules(env: Env) -> Iterator[None]:
    """Makes one line of programs that cannot be traced because the environment breaks a rule.

    The rules are looked at only then: to trace a step of the environment may take seconds.
    """
    try:
        yield
    except (UserError, RunError):
        raise
    except Exception as error:
        try:
            check_env.check_shapes(env)
        except EnvError as broken:
            what = one_line(broken)
            raise UserError(f"The environment {type(env).__name__}: {what}") from error
        except Exception:
            pass  # no rule, but an error in its code, of which the first one tells more
        with users_errors(""):
            raise


def physics_hash(env: Env) -> str | None:
    """Returns a sha256 of the model that an environment simulates; None if it has no `physics`."""
    model = getattr(getattr(env, "physics", None), "model", None)
    if model is None:
        return None
    return lookup.hash_model(model)
