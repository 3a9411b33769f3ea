"""The training loop: compiled programs, called from a host loop that evaluates and records.

The unit of compilation is ONE update (`compilation.py`). The host calls it `log_every` times
without waiting and then fetches the window's metrics at once. A scan over k updates would be a
program per k (and XLA inlines a loop of one trip), whose bits may differ; with the same programs
for all intervals, logging, evaluation and checkpoints cannot change a bit.
"""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from purerl.core.errors import RunError, StoppedError
from purerl.core.records import Metrics, PyTree, TrainState, count_as_int
from purerl.devices.programs import Programs
from purerl.ppo.config import Config, Evaluation
from purerl.runs import checkpoint_folder, state_arrays
from purerl.runs.loggers import MAX_SKIPPED_IN_A_ROW, Record, Say, summarize
from purerl.runs.writer import RunWriter

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
    writers: Sequence[RunWriter],
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
      writers: what writes metrics and checkpoints, one for each vmapped seed.
      progress: told of every chunk.
      stop: asked between chunks whether to save and stop.
      say: prints a line.
      meta: what every checkpoint says; "update" is where `state` is, "wall_s" the time that
        earlier lives of the run took.

    Raises:
      StoppedError: stopped on request, saved.
      RunError: the numbers are no longer finite, or the last checkpoint could not be saved.
    """
    number = len(writers)
    first = update = safe = meta["update"]  # safe: a kill after this update loses nothing
    begin = time.perf_counter()
    while update < plan.updates:
        if stop() and safe == update:
            break
        end = min((update // plan.log_every + 1) * plan.log_every, plan.updates)
        state, window = advance(programs, state, end - update)
        update = end
        seconds = time.perf_counter() - begin
        records = make_records(state, update, meta["wall_s"] + seconds, window, number)
        check_finite(state, records, writers)
        if update in plan.evaluations:
            judged = each_seed(jax.device_get(programs.evaluate(state)), number)
            for record, metrics in zip(records, judged, strict=True):
                found = summarize_evaluation(metrics)
                record |= {f"eval/{name}": value for name, value in found.items()}
            say(describe_evaluation(records, plan))
        planned = update in plan.checkpoints
        if planned or stop():
            _save(programs.fetch(state), records, writers, meta, planned)
            safe = update
        else:
            for writer, record in zip(writers, records, strict=True):
                writer.write(record)
        rate = (update - first) / (time.perf_counter() - begin)
        left = (plan.updates - update) / rate
        progress.show(shown_record(records), left, rate * plan.steps_per_update * number)
    for writer in writers:
        writer.finish()
    if update < plan.updates:
        state_of = "it is saved" if update else "there is nothing to save yet"
        raise StoppedError(f"Stopped after update {update} of {plan.updates}; {state_of}.")


def each_seed(tree: PyTree, number: int) -> list[PyTree]:
    """Cuts host arrays [S, ...] into those of each seed; of a single run they are its own."""
    if number == 1:
        return [tree]
    leaves, structure = jax.tree.flatten(tree)
    return [
        jax.tree.unflatten(structure, [np.array(leaf[i]) for leaf in leaves]) for i in range(number)
    ]


def advance(programs: Programs, state: TrainState, number: int) -> tuple[TrainState, list[Any]]:
    """Makes `number` updates and fetches their metrics, waiting for the device only once."""
    window = []
    for _ in range(number):
        state, metrics = programs.update(state)
        window.append(metrics)
    return state, jax.device_get(window)


def make_records(
    state: TrainState, update: int, wall_s: float, window: list[Any], number: int
) -> list[Record]:
    """Returns a chunk's line of metrics.jsonl for each seed."""
    steps = each_seed(jax.device_get(state.steps), number)
    windows = zip(*(each_seed(metrics, number) for metrics in window), strict=True)
    return [
        {"update": update, "steps": count_as_int(count), "wall_s": round(wall_s, 3)}
        | {f"train/{name}": value for name, value in summarize(metrics).items()}
        for count, metrics in zip(steps, windows, strict=True)
    ]


def shown_record(records: Sequence[Record]) -> Record:
    """Returns what progress shows: a run's own line, of many seeds their mean return, all lost."""
    returns = [r["train/episode_return"] for r in records]
    known = [value for value in returns if value is not None]
    return records[0] | {
        "train/episode_return": sum(known) / len(known) if known else None,
        "train/nonfinite_resets": sum(r["train/nonfinite_resets"] for r in records),
    }


def check_finite(
    state: TrainState, records: Sequence[Record], writers: Sequence[RunWriter]
) -> None:
    """Raises RunError when parameters are not finite, or nothing of late could be learnt from.

    Vmapped seeds stop together: they resume together, and a seed that is lost cannot be saved.
    """
    for i, record in enumerate(records):
        if not math.isfinite(record["train/parameter_norm"]):
            params = each_seed(state_arrays.flatten(state.params), len(records))[i]
            bad = [k for k, x in params.items() if not np.isfinite(x.astype(np.float64)).all()]
            reason = f"Parameters are not finite: {', '.join(bad) or 'their norm overflows'}. "
            _give_up(i, records, writers, reason + "Lower ppo.learning_rate.")
        if math.isnan(record["train/reward"]):
            reason = (
                "No step of an update was sound: of each, some number of the state is NaN or "
                "absurd. `purerl.core.env.check_env(env)` tells which."
            )
            _give_up(i, records, writers, reason)
        skipped = record["train/skipped_in_a_row"]
        if skipped >= MAX_SKIPPED_IN_A_ROW:
            reason = (
                f"The last {skipped:.0f} minibatches had a non-finite loss or gradient and were "
                "skipped. Lower ppo.learning_rate or ppo.reward_scale, or mend the environment's "
                "reward."
            )
            _give_up(i, records, writers, reason)


def _save(
    state: TrainState,
    records: Sequence[Record],
    writers: Sequence[RunWriter],
    meta: Record,
    planned: bool,
) -> None:
    parts = each_seed(state_arrays.flatten(state), len(records))
    for leaves, record, writer in zip(parts, records, writers, strict=True):
        score = record.get("eval/episode_return")
        about = meta | {name: record[name] for name in ("update", "steps", "wall_s")}
        about["eval_return"] = score if score is not None and math.isfinite(score) else None
        writer.save(record, leaves, about, planned)


def _give_up(
    lost: int, records: Sequence[Record], writers: Sequence[RunWriter], reason: str
) -> None:
    """Ends the run with an error about seed number `lost`; metrics are kept, the state is not."""
    for writer, record in zip(writers, records, strict=True):
        writer.write(record)
    for writer in writers:
        writer.close()
    folder = writers[lost].checkpoints
    found = checkpoint_folder.updates(folder)
    kept = checkpoint_folder.path_of(folder, found[-1]) if found else "none"
    raise RunError(
        f"Update {records[lost]['update']} of {folder.parent}: {reason} The last good checkpoint "
        f"is {kept}."
    )


def describe_evaluation(records: Sequence[Record], plan: Plan) -> str:
    """Returns an evaluation as one line for a person; of many seeds the mean over them."""
    mean = {name: np.mean([record[name] for record in records]) for name in records[0]
            if name.startswith("eval/")}  # fmt: skip
    spread, over = mean["eval/episode_return_std"], ""
    if len(records) > 1:
        spread = np.std([record["eval/episode_return"] for record in records])
        over = f" over {len(records)} seeds"
    lost = mean["eval/lost"]
    return (
        f"update {records[0]['update']}/{plan.updates}  steps {records[0]['steps']:,}  evaluation: "
        f"return {mean['eval/episode_return']:.2f} +- {spread:.2f}{over}, "
        f"episode length {mean['eval/episode_length']:.0f}" + (f", {lost:.0%} lost" if lost else "")
    )
