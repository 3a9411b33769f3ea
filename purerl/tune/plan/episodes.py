"""Episodes that a planner plays, as arrays: the beginnings are those of `evaluate`."""

import functools
from collections.abc import Callable, Iterator, Mapping
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from purerl.core.env import Env, State
from purerl.core.keys import Purpose, derive, per_environment
from purerl.core.records import Array
from purerl.devices.compilation import jit
from purerl.ppo import evaluation
from purerl.ppo.config import Config
from purerl.tune.plan import planner
from purerl.tune.plan.settings import Settings

TERM = "reward_"  # the name of a metric that is a term of the reward begins so
CHUNK = 20  # control steps that one call of the program plays


class Playing(NamedTuple):
    """Episodes that are being played, [E, ...]."""

    progress: evaluation.Progress
    plan: planner.Plan


def advance(
    settings: Settings,
    env: Env,
    judges: Mapping[str, Env],
    keep: Callable[[State], Any],
    guide: planner.Guide,
    key: Array,
    playing: Playing,
) -> tuple[Playing, dict[str, Any]]:
    """Plans and takes one control step in each of E episodes; pure.

    Args:
      settings: of the planner.
      env: the environment.
      judges: name -> the environment under some settings: each gives the reward, and its terms
        (metrics named `reward_*`), that it would have given for the same action in the same state.
      keep: what to keep of each state, before the step; of one environment.
      guide: see `planner.plan`.
      key: [] typed, of all steps.
      playing: the episodes.

    Returns:
      The episodes one step later, and arrays [E, ...] by name: "running", whether the step belongs
      to the episode, "kept", "action", "reward", "metrics" and "judged".
    """
    now, number = playing.progress, len(playing.progress.over)
    keys = per_environment(jax.random.fold_in(key, now.t), jnp.arange(number))
    choose = functools.partial(planner.plan, settings, env, guide)
    plans, action = jax.vmap(choose)(playing.plan, now.env_state, keys)
    following = evaluation.advance(env, now, action, ())
    judged = {name: judge_step(judge, now.env_state, action) for name, judge in judges.items()}
    row = {
        "running": ~(now.over | following.lost),
        "kept": jax.vmap(keep)(now.env_state),
        "action": action,
        "reward": following.env_state.reward,
        "metrics": following.env_state.metrics,
        "judged": judged,
    }
    return Playing(following, plans), row


def judge_step(judge: Env, state: State, action: Array) -> dict[str, Array]:
    """Returns what a judge says of one step, [E] each.

    The reward, as "return", its terms, and whether the judge's episode ends with it, as "over".
    """
    found = jax.vmap(judge.step)(state, action)
    terms = {name: x for name, x in found.metrics.items() if name.startswith(TERM)}
    return {"return": found.reward, "over": found.terminated | found.truncated} | terms


def episodes(
    config: Config,
    settings: Settings,
    env: Env,
    make_guide: Callable[[Any], planner.Guide],
    learned: Any,
    seed: int,
    number: int,
    judges: Mapping[str, Env] | None = None,
    keep: Callable[[State], Any] = lambda state: (),
) -> Iterator[tuple[Playing, dict[str, Any]]]:
    """Plays E whole episodes; yields them and arrays [T, E, ...] after every few steps.

    What it yields may still be being computed. Two programs are compiled: the beginning, and
    `CHUNK` control steps, each with its plan.

    Args:
      config: for the time limit.
      settings: of the planner.
      env: the environment.
      make_guide: makes the guide, in the program, of `learned`.
      learned: arrays.
      seed: of the episodes and plans.
      number: E.
      judges: see `advance`.
      keep: see `advance`.
    """
    others = judges or {}

    def first(learned: Any, key: Array) -> Playing:
        nothing: Any = SimpleNamespace(memory=())  # the guide's memory is in the plan
        plan = planner.start(settings, env, make_guide(learned))
        plans = jax.tree.map(lambda x: jnp.broadcast_to(x, (number, *x.shape)), plan)
        return Playing(evaluation.start(env, nothing, key, number, config.episode_length), plans)

    def chunk(learned: Any, key: Array, playing: Playing) -> tuple[Playing, dict[str, Any]]:
        step = functools.partial(advance, settings, env, others, keep, make_guide(learned), key)
        return jax.lax.scan(lambda now, _: step(now), playing, length=CHUNK)

    # As `evaluation.evaluate_policy` does: the same beginnings.
    reset_key, key = jax.random.split(derive(jax.random.key(seed), Purpose.EVALUATION))
    playing, go_on = jit("plan_start", first)(learned, reset_key), jit("plan", chunk)
    while True:
        playing, rows = go_on(learned, key, playing)
        yield playing, rows
        if bool(np.all(playing.progress.over)):
            return


def results(playing: Playing) -> dict[str, np.ndarray]:
    """Returns figures of episodes that are over, name -> [E], as `evaluation.evaluate_policy`."""
    found = evaluation.results(playing.progress)
    return {name: np.asarray(x, float) for name, x in found.items()}
