"""The training loop: compiled programs, called from a host loop that evaluates and records.

One update is compiled (`programs.py`). The host calls it `log_every` times without waiting, then
fetches the metrics at once. A scan over k updates would be another program for each k, whose bits
may differ. With one program, logging, evaluation and checkpoints cannot change a bit.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from purerl.checks import check_env, user_code
from purerl.core.errors import RunError, StoppedError
from purerl.core.records import Metrics, PyTree, TrainState, count_as_int
from purerl.devices.programs import Programs
from purerl.machine import state_arrays
from purerl.runs import checkpoint_folder
from purerl.runs.metrics_file import MAX_SKIPPED_IN_A_ROW, Record, deviation
from purerl.training.plan import Plan
from purerl.training.writer import RunWriter

LEAST_SCALE = 1e-6  # of a policy: the density of a smaller one overflows, or its gradient
COUNTS = ("episodes", "nonfinite_resets", "replayed_resets", "skipped_minibatches")


def train(
    plan: Plan,
    programs: Programs,
    state: TrainState,
    writers: Sequence[RunWriter],
    progress: Any,
    stop: Callable[[], bool],
    meta: Record,
    best: Sequence[float],
    listener: Callable[[Record], Any] | None = None,
) -> None:
    """Runs from `state` to the end of the plan, or to a requested stop.

    Args:
      plan: what to do when.
      programs: the compiled functions.
      state: where to begin; it is consumed.
      writers: what writes metrics and checkpoints, one for each vmapped seed.
      progress: what shows each chunk and says lines; see `console.progress`.
      stop: asked between chunks whether to save and stop.
      meta: what every checkpoint says; "update" is where `state` is, "wall_s" the time [s] that
        earlier lives of the run took.
      best: each seed's highest evaluation return so far, -inf without one. What is better is saved,
        so that the best evaluation has a checkpoint.
      listener: a user's function that is called with each chunk's record, as it is shown.

    Raises:
      UserError: what `listener` raised.
      StoppedError: stopped on request, saved.
      RunError: the numbers are no longer finite, or the last checkpoint could not be saved.
    """
    check_env.forget_lost()
    number = len(writers)
    first = update = safe = meta["update"]  # safe: a kill after this update loses nothing
    begin = time.perf_counter()
    while update < plan.updates:
        if stop() and safe == update:
            break
        end = min((update // plan.log_every + 1) * plan.log_every, plan.updates)
        state, window = _advance(programs, state, end - update)
        update = end
        seconds = time.perf_counter() - begin
        records = _make_records(state, update, meta["wall_s"] + seconds, window, number)
        _check_finite(programs, state, records, writers)
        better = best
        if update in plan.evaluations:
            judged = _each_seed(jax.device_get(programs.evaluate(state)), number)
            for record, metrics in zip(records, judged, strict=True):
                record |= _summarize_evaluation(metrics)
            progress.say(_describe_evaluation(records, plan))
            scores = [record["eval/episode_return"] for record in records]
            better = [max(old, new) for old, new in zip(best, scores, strict=True)]  # no NaN
        planned = update in plan.checkpoints
        if planned or better != best or stop():
            _save(programs.fetch(state), records, writers, meta, planned)
            safe = update
        else:
            for writer, record in zip(writers, records, strict=True):
                writer.write(record)
        best = better
        rate = (update - first) / (time.perf_counter() - begin)
        left = (plan.updates - update) / rate
        progress.show(shown := shown_record(records), left, rate * plan.steps_per_update * number)
        if listener:
            with user_code.users_errors("on_metrics: "):
                listener(shown)
    for writer in writers:
        writer.finish()
    if update < plan.updates:
        state_of = "it is saved" if update else "there is nothing to save yet"
        raise StoppedError(f"Stopped after update {update} of {plan.updates}; {state_of}.")


def _each_seed(tree: PyTree, number: int) -> list[PyTree]:
    """Cuts host arrays [S, ...] into those of each seed; of a single run they are its own."""
    if number == 1:
        return [tree]
    return [jax.tree.map(lambda leaf, i=i: np.array(leaf[i]), tree) for i in range(number)]


def _advance(programs: Programs, state: TrainState, number: int) -> tuple[TrainState, list[Any]]:
    """Makes `number` updates and fetches their metrics, waiting for the device only once."""
    window = []
    for _ in range(number):
        state, metrics = programs.update(state)
        window.append(metrics)
    return state, jax.device_get(window)


def _make_records(
    state: TrainState, update: int, wall_s: float, window: list[Any], number: int
) -> list[Record]:
    """Returns a chunk's line of metrics.jsonl for each seed."""
    steps = _each_seed(jax.device_get(state.steps), number)
    windows = zip(*(_each_seed(metrics, number) for metrics in window), strict=True)
    return [
        {"update": update, "steps": count_as_int(count), "wall_s": round(wall_s, 3)}
        | {f"train/{name}": value for name, value in summarize(metrics).items()}
        for count, metrics in zip(steps, windows, strict=True)
    ]


def summarize(window: Sequence[Mapping[str, Any]]) -> Record:
    """Joins the metrics of several updates: counts are summed, the rest is averaged.

    Metrics of episodes that ended (`episode...`) are averaged over the episodes, not over the
    updates. They are None if no episode ended.
    """
    counts = [float(metrics["episodes"]) for metrics in window]
    record: Record = {}
    for name in window[0]:
        values = [float(metrics[name]) for metrics in window]
        if name in COUNTS:
            record[name] = sum(values)
        elif name == "skipped_in_a_row":
            record[name] = values[-1]
        elif name.startswith("episode"):
            # An update without an ended episode has nothing to say: not 0, and not NaN.
            weighted = sum(v * n for v, n in zip(values, counts, strict=True) if n)
            record[name] = weighted / sum(counts) if sum(counts) else None
        else:
            record[name] = sum(values) / len(values)
    return record


def _summarize_evaluation(metrics: Metrics) -> Record:
    """Averages evaluation metrics, name -> [N], with the spread of the return."""
    arrays = {name: np.asarray(value, np.float64) for name, value in metrics.items()}
    record = {f"eval/{name}": float(values.mean()) for name, values in sorted(arrays.items())}
    returns = arrays["episode_return"]
    spread = {"std": deviation(returns), "min": returns.min(), "max": returns.max()}
    return record | {f"eval/episode_return_{name}": float(x) for name, x in spread.items()}


def _describe_evaluation(records: Sequence[Record], plan: Plan) -> str:
    """Returns an evaluation as one line for a person; of many seeds the mean over them."""
    mean = {name: np.mean([record[name] for record in records]) for name in records[0]
            if name.startswith("eval/")}  # fmt: skip
    spread, over = mean["eval/episode_return_std"], ""
    if len(records) > 1:
        spread = deviation(np.array([record["eval/episode_return"] for record in records]))
        over = f" over {len(records)} seeds"
    lost = mean["eval/lost"]
    return (
        f"update {records[0]['update']}/{plan.updates}  steps {records[0]['steps']:,}  evaluation: "
        f"return {mean['eval/episode_return']:.2f} +- {spread:.2f}{over}, "
        f"episode length {mean['eval/episode_length']:.0f}" + (f", {lost:.0%} lost" if lost else "")
    )


def shown_record(records: Sequence[Record]) -> Record:
    """Returns what progress shows: a run's own line, of many seeds their mean return, all episodes.

    The length is that of the seed with the longest.
    """
    returns = [r["train/episode_return"] for r in records]
    known = [value for value in returns if value is not None]
    return records[0] | {
        "train/episode_return": sum(known) / len(known) if known else None,
        "train/nonfinite_resets": sum(r["train/nonfinite_resets"] for r in records),
        "train/episodes": sum(r["train/episodes"] for r in records),
        "train/episode_length": max(r["train/episode_length"] or 0.0 for r in records),
    }


def _check_finite(
    programs: Programs, state: Any, records: Sequence[Record], writers: Sequence[RunWriter]
) -> None:
    """Raises RunError when parameters are not finite, or nothing of late could be learnt from.

    Metrics are kept, the state is not. Vmapped seeds stop together: they resume together, and a
    seed that is lost cannot be saved.
    """
    reasons = [_why_lost(programs, state, records, seed) for seed in range(len(records))]
    lost = next((seed for seed, reason in enumerate(reasons) if reason), None)
    if lost is None:
        return
    for writer, record in zip(writers, records, strict=True):
        writer.write(record)
    for writer in writers:
        writer.close()
    folder = writers[lost].checkpoints
    found = checkpoint_folder.updates(folder)
    kept = checkpoint_folder.path_of(folder, found[-1]) if found else "none"
    raise RunError(
        f"Update {records[lost]['update']} of {folder.parent}: {reasons[lost]} The last good "
        f"checkpoint is {kept}."
    )


def _why_lost(programs: Programs, state: Any, records: Sequence[Record], seed: int) -> str:
    """Returns why the seed of that place cannot go on, "" if it can."""
    record = records[seed]
    if not math.isfinite(record["train/parameter_norm"]):
        params = _each_seed(state_arrays.flatten(state.params), len(records))[seed]
        bad = [k for k, x in params.items() if not np.isfinite(x.astype(np.float64)).all()]
        names = ", ".join(bad) or "their norm overflows"
        return f"Parameters are not finite: {names}. Lower ppo.learning_rate."
    skipped, nowhere = record["train/skipped_in_a_row"], math.isnan(record["train/reward"])
    if not nowhere and skipped < MAX_SKIPPED_IN_A_ROW:
        return ""
    whole = programs.fetch(state)
    part, policy = check_env.lost_part(whole.env_state), jax.device_get(programs.policy(whole))
    (loc, scale), _, losses = _each_seed(policy, len(records))[seed]
    # Where observations are not sound, the policy cannot be.
    if not part and not (np.isfinite(loc + scale).all() and np.min(scale) >= LEAST_SCALE):
        return (
            f"The policy's loc is {np.min(loc):.3g} to {np.max(loc):.3g}, and its scale "
            f"{np.min(scale):.3g} to {np.max(scale):.3g}; they must be finite, and scales at least "
            f"{LEAST_SCALE:g}: let the network keep them so, a scale by jax.nn.softplus(x) + 0.01."
        )
    if nowhere:
        return (
            "No step of an update was sound: of each, some number of the state is NaN or absurd, "
            f"which `purerl.check_env(env)` names. {part}"
        ).strip()
    said = f"The last {skipped:.0f} minibatches had a non-finite loss or gradient and were skipped."
    bad = [name for name, x in losses.items() if not np.isfinite(x).all()]
    if bad and not part:
        return f"{said} The network's loss {', '.join(bad)} is not finite: mend it there."
    own = f" or the network's losses ({', '.join(losses)})" * bool(losses)
    cure = f"Lower ppo.learning_rate or ppo.reward_scale, or mend the environment's reward{own}."
    return f"{said} {cure}"


def _save(
    state: TrainState,
    records: Sequence[Record],
    writers: Sequence[RunWriter],
    meta: Record,
    planned: bool,
) -> None:
    parts = _each_seed(state_arrays.flatten(state), len(records))
    for leaves, record, writer in zip(parts, records, writers, strict=True):
        score = record.get("eval/episode_return")
        about = meta | {name: record[name] for name in ("update", "steps", "wall_s")}
        about["eval_return"] = score if score is not None and math.isfinite(score) else None
        writer.save(record, leaves, about, planned)
