"""What moves the body: a reset and a step of the environment, compiled, with live options.

`build_env(options)` is a function, so most numbers of the options can be arguments of the compiled
program: those that only enter arithmetic, such as the weights of a reward. A slider of theirs acts
in the very next step. Which they are is found out by tracing with each of them alone. The others
shape the model, or are compared with something while the environment is built; a change of theirs
takes a new program, which is built beside the old one.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from purerl.core.env import State
from purerl.core.errors import RunError, UserError, one_line
from purerl.core.keys import Purpose, derive
from purerl.core.records import Array, PyTree
from purerl.devices.compilation import jit, start as compile_beside
from purerl.experiment.objects import check_observation
from purerl.ppo.episodes import is_lost
from purerl.report import episode_pictures, renderer
from purerl.tune.option_numbers import Place, numbers_of, replaced
from purerl.tune.view.drivers import Driver

Numbers = Mapping[Place, int | float]


class Moment(struct.PyTreeNode):
    """An episode between two control steps."""

    env: State
    memory: PyTree
    key: Array  # [] of the episode
    step: Array  # [] int32 control steps done


class Shown(NamedTuple):
    """What a control step shows; numpy on the host."""

    picture: episode_pictures.Picture  # after the step
    reward: Array  # []
    metrics: dict[str, Array]  # name -> []
    action: Array  # [A]
    value: Array  # [] before the step, as the driver counts it
    terminated: Array  # [] bool
    truncated: Array  # [] bool
    lost: Array  # [] bool


class Program(NamedTuple):
    """One environment and its driver, compiled."""

    env: Any
    live: dict[Place, int | float]  # numbers that are arguments: their first values
    fixed: dict[Place, int | float]  # numbers that it was built with
    start: Callable[[Numbers, Array], tuple[Moment, episode_pictures.Picture]]
    step: Callable[[Numbers, PyTree, Moment], tuple[Moment, Shown]]


def episode_key(seed: int, episode: int) -> Array:
    """Returns the key [] of a seed's episode."""
    return derive(jax.random.key(seed), Purpose.VIDEO, episode)


def build_program(
    build_env: Callable[[Any, str], Any],
    options: Any,
    engine: str,
    driver: Driver,
    brain: PyTree,
    observed: PyTree = None,
) -> Program:
    """Builds an environment with its driver, and compiles them.

    Args:
      build_env: the experiment's.
      options: the environment's.
      engine: of physics, not "auto".
      driver: who chooses the actions.
      brain: for its shapes.
      observed: shapes of the observation that the driver has learned from; None: any.

    Raises:
      UserError: the options break a rule, or make an environment that cannot be driven or drawn.
    """
    try:
        env = build_env(options, engine)
        renderer.model_of(env)
        if observed is not None:
            check_observation(env, observed)
        every = numbers_of(options)
        live = find_live(lambda values: build_env(replaced(options, values), engine), every)
        names = tuple(live)

        def built(values: tuple) -> Any:
            changed = dict(zip(names, values, strict=True))
            return build_env(replaced(options, changed), engine) if names else env

        key, values = jax.random.key(0), tuple(live.values())
        first = jax.eval_shape(lambda key: begin(env, driver, key), key)[0]
        # Both at the level of a program that shall be ready soon, side by side.
        programs: list[tuple[Callable, tuple]] = [
            (lambda v, k: begin(built(v), driver, k), (values, key)),
            (lambda v, b, m: move(built(v), driver, b, m), (values, brain, first)),
        ]
        compiled = [compile_beside("init", jit("init", f).trace(*given)) for f, given in programs]
        start, step = (program.result()[0] for program in compiled)
    except (UserError, RunError):
        raise
    except Exception as error:  # of the environment's code: any
        raise UserError(one_line(error)) from error
    fixed = {place: value for place, value in every.items() if place not in live}

    def taken(numbers: Numbers) -> tuple:  # each of the type that it had
        return tuple(type(first)(numbers[place]) for place, first in live.items())

    return Program(
        env, live, fixed,
        start=lambda numbers, key: _on_host(*start(taken(numbers), key)),
        step=lambda numbers, brain, moment: _on_host(*step(taken(numbers), brain, moment)),
    )  # fmt: skip


def _on_host(moment: Moment, shown: Any) -> tuple[Moment, Any]:
    return moment, jax.device_get(shown)


def find_live(build: Callable[[Numbers], Any], numbers: Numbers) -> dict[Place, int | float]:
    """Returns the numbers that may be arguments of a program of `build(numbers)`.

    Each is tried alone, then all of them: what is compared or counted with when the environment is
    built raises.
    """

    def traces(chosen: dict[Place, Any]) -> bool:
        def one_step(values: list[Any], key: Array) -> Any:
            env = build(dict(zip(chosen, values, strict=True)))
            return env.step(env.reset(key), jnp.zeros(env.action_size))

        try:
            jax.eval_shape(one_step, list(chosen.values()), jax.random.key(0))
        except Exception:  # of JAX, MuJoCo, numpy, or of a rule that met a number without a value
            return False
        return True

    live = {place: value for place, value in numbers.items() if traces({place: value})}
    return live if traces(live) else {}


def begin(env: Any, driver: Driver, key: Array) -> tuple[Moment, episode_pictures.Picture]:
    """Starts an episode."""
    state = env.reset(jax.random.fold_in(key, 0))
    first = Moment(state, driver.start(env), key, jnp.zeros((), jnp.int32))
    return first, episode_pictures.take_picture(env, state)


def move(env: Any, driver: Driver, brain: PyTree, moment: Moment) -> tuple[Moment, Shown]:
    """Takes one control step."""
    key = jax.random.fold_in(moment.key, moment.step + 1)  # 0 was the start's
    action, value, memory = driver.act(env, brain, moment.env, moment.memory, key)
    state = env.step(moment.env, action)
    shown = Shown(
        picture=episode_pictures.take_picture(env, state),
        reward=state.reward,
        metrics=state.metrics,
        action=action,
        value=value,
        terminated=state.terminated,
        truncated=state.truncated,
        lost=is_lost(state),
    )
    return Moment(state, memory, moment.key, moment.step + 1), shown
