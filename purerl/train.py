"""The training loop: compiled programs, called from a host loop that evaluates and records.

The unit of compilation is ONE update. The host calls it `log_every` times without waiting and then
fetches the window's metrics at once. A scan over k updates would be a program per k (and XLA
inlines a loop of one trip), whose bits may differ; with one program for all intervals, logging,
evaluation and checkpoints cannot change a bit.
"""

import functools
import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from purerl import checkpoint, ppo
from purerl.config import Config
from purerl.env import Env
from purerl.errors import RunError, StoppedError
from purerl.evaluation import evaluate
from purerl.experiment import Evaluation
from purerl.keys import Purpose, derive
from purerl.loggers import Record, Say, summarize
from purerl.recorder import Recorder
from purerl.types import Array, Metrics, Network, PyTree, TrainState, count_as_int

MAX_SKIPPED_IN_A_ROW = 10
DEFAULT_LINES = 500  # in metrics.jsonl, about


class Plan(NamedTuple):
    """A run's sizes, rounded once and up front."""

    updates: int
    steps_per_update: int
    log_every: int  # updates between two lines of metrics.jsonl
    evaluations: tuple[int, ...]  # after these updates
    checkpoints: tuple[int, ...]  # after these updates; the last one always

    @property
    def steps(self) -> int:
        """Control steps of the whole run."""
        return self.updates * self.steps_per_update


def make_plan(config: Config, evaluation: Evaluation, checkpoints: int, log_every: int) -> Plan:
    """Rounds a run to whole updates, and what happens between them to whole chunks.

    Args:
      config: for the budget; the plan never takes more than `config.num_steps` steps.
      evaluation: for the number of evaluations.
      checkpoints: how many, evenly spaced; at least the last is always taken.
      log_every: updates in a chunk; 0 chooses one with about `DEFAULT_LINES` chunks.
    """
    updates = config.num_updates
    log_every = min(log_every or max(1, updates // DEFAULT_LINES), updates)
    return Plan(
        updates=updates,
        steps_per_update=config.steps_per_update,
        log_every=log_every,
        evaluations=evenly(evaluation.number, updates, log_every),
        checkpoints=evenly(max(checkpoints, 1), updates, log_every),
    )


def evenly(number: int, updates: int, every: int) -> tuple[int, ...]:
    """Spreads `number` events over the run, each at the end of a chunk, the last at the run's."""
    chunks = [-(-updates * i // (number * every)) for i in range(1, number + 1)]
    return tuple(sorted({min(chunk * every, updates) for chunk in chunks}))


class Programs(NamedTuple):
    """A run's compiled functions."""

    init: Callable[[Array], TrainState]
    update: Callable[[TrainState], tuple[TrainState, Metrics]]
    evaluate: Callable[[TrainState], Metrics]
    seconds: dict[str, float]  # that compiling each took


def abstract_state(config: Config, env: Env, network: Network) -> PyTree:
    """Returns the shapes and dtypes of a run's state without computing anything."""
    return jax.eval_shape(functools.partial(ppo.init, config, env, network), jax.random.key(0))


def compile_programs(
    config: Config, env: Env, network: Network, evaluation: Evaluation, fresh: bool
) -> Programs:
    """Compiles what a run calls; `init` only for a fresh one, `evaluate` only if planned."""
    seconds: dict[str, float] = {}
    abstract = abstract_state(config, env, network)
    # Initialisation is one program too: computed eagerly, its bits are others.
    init = jax.jit(functools.partial(ppo.init, config, env, network))
    update = jax.jit(functools.partial(ppo.update, config, env, network), donate_argnums=0)
    judge = jax.jit(functools.partial(evaluate_in_run, config, env, network, evaluation))
    key = jax.random.key(0)
    return Programs(
        init=_compile("init", init, key, seconds) if fresh else init,
        update=_compile("update", update, abstract, seconds),
        evaluate=_compile("evaluation", judge, abstract, seconds) if evaluation.number else judge,
        seconds=seconds,
    )


def _compile(name: str, function: Any, argument: PyTree, seconds: dict[str, float]) -> Any:
    start = time.perf_counter()
    compiled = function.lower(argument).compile()
    seconds[name] = time.perf_counter() - start
    return compiled


def evaluate_in_run(
    config: Config, env: Env, network: Network, evaluation: Evaluation, state: TrainState
) -> Metrics:
    """Evaluates the deterministic policy on episodes that depend on seed and update alone."""
    key = derive(state.key, Purpose.EVALUATION, state.update)
    return evaluate(config, env, network, state, key, evaluation.num_episodes)


def summarize_evaluation(metrics: Metrics) -> Record:
    """Averages evaluation metrics, name -> [N], with the spread of the return."""
    arrays = {name: np.asarray(value, np.float64) for name, value in metrics.items()}
    record = {name: float(values.mean()) for name, values in sorted(arrays.items())}
    returns = arrays["episode_return"]
    record["episode_return_std"] = float(returns.std())
    record["episode_return_min"] = float(returns.min())
    record["episode_return_max"] = float(returns.max())
    return record


class Progress(Protocol):
    """Shows a person how far the run is."""

    def show(self, record: Record, seconds_left: float, steps_per_second: float) -> None:
        """Shows one chunk."""
        ...


def train(
    plan: Plan,
    programs: Programs,
    state: TrainState,
    recorder: Recorder,
    progress: Progress,
    stop: Callable[[], bool],
    say: Say,
    meta: Record,
) -> None:
    """Runs from `state` to the end of the plan, or to a requested stop.

    Args:
      plan: what to do when.
      programs: the compiled functions.
      state: where to begin; it is consumed.
      recorder: what writes metrics and checkpoints.
      progress: told of every chunk.
      stop: asked between chunks whether to save and stop.
      say: prints a line.
      meta: what every checkpoint says; "wall_s" is the time that earlier lives of the run took.

    Raises:
      StoppedError: stopped on request, saved.
      RunError: the numbers are no longer finite, or the last checkpoint could not be saved.
    """
    first = update = safe = int(state.update)  # safe: a kill after this update loses nothing
    begin = time.perf_counter()
    while update < plan.updates:
        if stop() and safe == update:
            break
        end = min((update // plan.log_every + 1) * plan.log_every, plan.updates)
        state, window = advance(programs, state, end - update)
        update = end
        seconds = time.perf_counter() - begin
        record = make_record(state, update, meta["wall_s"] + seconds, window)
        check_skipped(record, recorder)
        if update in plan.evaluations:
            judged = summarize_evaluation(jax.device_get(programs.evaluate(state)))
            record |= {f"eval/{name}": value for name, value in judged.items()}
            say(describe_evaluation(record, plan))
        planned = update in plan.checkpoints
        if planned or stop():
            _save(state, record, recorder, meta, planned)
            safe = update
        else:
            recorder.write(record)
        rate = (update - first) / (time.perf_counter() - begin)
        progress.show(record, (plan.updates - update) / rate, rate * plan.steps_per_update)
    recorder.finish()
    if update < plan.updates:
        raise StoppedError(f"Stopped after update {update} of {plan.updates}; it is saved.")


def advance(programs: Programs, state: TrainState, number: int) -> tuple[TrainState, list[Any]]:
    """Makes `number` updates and fetches their metrics, waiting for the device only once."""
    window = []
    for _ in range(number):
        state, metrics = programs.update(state)
        window.append(metrics)
    return state, jax.device_get(window)


def make_record(state: TrainState, update: int, wall_s: float, window: list[Any]) -> Record:
    """Returns a chunk's line of metrics.jsonl."""
    steps = count_as_int(jax.device_get(state.steps))
    trained = {f"train/{name}": value for name, value in summarize(window).items()}
    return {"update": update, "steps": steps, "wall_s": round(wall_s, 3)} | trained


def check_skipped(record: Record, recorder: Recorder) -> None:
    """Raises RunError when every minibatch of late was non-finite and had to be skipped."""
    skipped = record["train/skipped_in_a_row"]
    if skipped >= MAX_SKIPPED_IN_A_ROW:
        _give_up(
            record, recorder,
            f"The last {skipped:.0f} minibatches had a non-finite loss or gradient and were "
            "skipped. Lower ppo.learning_rate or ppo.reward_scale, or mend the environment's "
            "reward."
        )  # fmt: skip


def _save(
    state: TrainState, record: Record, recorder: Recorder, meta: Record, planned: bool
) -> None:
    leaves = checkpoint.flatten(state)
    learned = {path: x for path, x in leaves.items() if path.split("/")[0] == "params"}
    bad = [path for path, x in learned.items() if not np.isfinite(x.astype(np.float64)).all()]
    if bad:
        _give_up(record, recorder, f"Parameters are not finite: {', '.join(bad)}.")
    score = record.get("eval/episode_return")
    meta = meta | {
        "update": record["update"],
        "steps": record["steps"],
        "wall_s": record["wall_s"],
        "eval_return": score if score is not None and math.isfinite(score) else None,
    }
    recorder.save(record, leaves, meta, planned)


def _give_up(record: Record, recorder: Recorder, reason: str) -> None:
    """Ends the run with an error; its metrics are kept, its state is not."""
    recorder.write(record)
    recorder.close()
    found = checkpoint.updates(recorder.checkpoints)
    kept = recorder.checkpoints / f"{found[-1]:012d}" if found else "none"
    raise RunError(f"Update {record['update']}: {reason} The last good checkpoint is {kept}.")


def describe_evaluation(record: Record, plan: Plan) -> str:
    """Returns an evaluation as one line for a person."""
    return (
        f"update {record['update']}/{plan.updates}  steps {record['steps']:,}  evaluation: return "
        f"{record['eval/episode_return']:.2f} +- {record['eval/episode_return_std']:.2f}, "
        f"episode length {record['eval/episode_length']:.0f}"
    )
