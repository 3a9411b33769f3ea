"""What a person sees of a run: the plan, a live bar on a terminal, plain lines elsewhere."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax

from purerl.checks.examine_network import trained
from purerl.core.records import PyTree
from purerl.devices import memory, threads
from purerl.experiment.objects import Setup
from purerl.machine import output
from purerl.ppo.config import Config
from purerl.runs.metrics_file import Record
from purerl.training.plan import Plan

SECONDS_BETWEEN_LINES = 2.0
# Or one would think that it hangs.
SLOW_BEGINNING = "; its kernels, once on a machine, take a minute or more of an update"
WARP_ON_CPU = "; on a CPU it is for tests only: take engine c"
# Where NPROC says two, or JAX began before this run: else `threads.leave_one` has left one.
STALLS = "; on two of XLA's threads its physics can stop for ever: set NPROC=1, or take engine c"


def describe_plan(
    plan: Plan, setup: Setup, abstract: PyTree, facts: dict[str, Any], runs: list[Path], cache: str
) -> list[str]:
    """Returns every derived number of a run, as lines, before anything heavy starts.

    Args:
      plan: the run's sizes.
      setup: the experiment's objects.
      abstract: shapes of the state.
      facts: of manifest.json.
      runs: the folder of each seed.
      cache: the folder of compiled programs.
    """
    left = setup.config.num_steps - plan.steps
    rounded = f", {left:,} fewer than num_steps: whole updates only" if left else ""
    number, devices, kind = facts["num_shards"], facts["devices"], facts["device"]
    each = f"{setup.config.num_envs // number} environments each, {number // devices} on a device"
    how = "one after another: the bits of single runs"
    if "vmapped_seeds" in facts:
        how = "vmapped: the statistics of single runs, other bits"
    inexact = "; ".join(facts["inexact_because"])
    parameters = sum(leaf.size for leaf in jax.tree.leaves(trained(abstract.params)))
    lines = {
        "run": runs[0],
        "seeds": len(runs) > 1 and f"{len(runs)}, to {runs[-1].name}, {how}",
        "updates": f"{plan.updates:,} of {plan.steps_per_update:,} steps",
        "steps": f"{plan.steps:,}{rounded}",
        "evaluations": _ticks(plan.evaluations),
        "episodes": training_episodes(setup.config),
        "checkpoints": _ticks(plan.checkpoints),
        "metrics": f"a line every {plan.log_every} updates",
        "parameters": f"{parameters:,}",
        "state": f"{memory.size(abstract) / 1e6:,.1f} MB",
        "engine": f"{setup.engine}{engine_remark(setup.engine, kind)}",
        "shards": number > 1 and f"{number}, {each}",
        "stepped by": "; ".join(facts.get("stepped_by", ())),
        "device": f"{devices} x {kind['kind']} ({kind['platform']})",
        "cache": cache,
        "bit-exact": f"no: {inexact}" if inexact else "yes",
    }
    return [f"{name:12} {value}" for name, value in lines.items() if value]


def engine_remark(engine: str, device: dict[str, Any]) -> str:
    """Returns what to know beforehand of an engine on a device, as in manifest.json."""
    if engine == "jax" and device.get("threads") == threads.STALLING:  # a CPU's
        return STALLS
    if engine == "warp":
        return (WARP_ON_CPU if device["platform"] == "cpu" else "") + SLOW_BEGINNING
    return ""


def training_episodes(config: Config) -> str:
    """Returns how long training's episodes are, or "" where all are as long as an evaluation's."""
    if not 0 < config.shortest_episode < config.episode_length:
        return ""
    lengths = f"{config.shortest_episode:,} to {config.episode_length:,} steps"
    return f"{lengths} in training, whole in evaluations: do not compare their returns"


def _ticks(updates: tuple[int, ...]) -> str:
    return f"{len(updates)}, the first after update {updates[0]:,}" if updates else "none"


class _Lines:
    """Progress as plain lines, for logs and pipes."""

    def __init__(self, updates: int) -> None:
        self.updates = updates
        self.shown = 0.0  # when, by the monotonic clock [s]

    def say(self, line: str) -> None:
        output.say(line)

    def show(self, record: Record, seconds_left: float, steps_per_second: float) -> None:
        """Prints a line for a chunk, unless one has just been printed."""
        now, update = time.monotonic(), record["update"]
        if now - self.shown >= SECONDS_BETWEEN_LINES or update >= self.updates:
            self.shown = now
            text = figures(record, seconds_left, steps_per_second)
            self.say(f"update {update}/{self.updates}  {text}")


class _Bar:
    """Progress as a live bar, for a terminal; `bar` is a `rich` display."""

    def __init__(self, updates: int, bar: Any) -> None:
        self.bar = bar
        self.task = bar.add_task("", total=updates)

    def say(self, line: str) -> None:
        line = output.printable(line)
        self.bar.console.print(line, highlight=False, markup=False, soft_wrap=True)

    def show(self, record: Record, seconds_left: float, steps_per_second: float) -> None:
        text = figures(record, seconds_left, steps_per_second)
        self.bar.update(self.task, completed=record["update"], description=text)


def figures(record: Record, seconds_left: float, steps_per_second: float) -> str:
    """Returns a chunk's figures as a person reads them."""
    value = record.get("train/episode_return")
    shown = "-" if value is None else f"{value:.2f}"
    minutes, seconds = divmod(round(seconds_left), 60)
    left = f"{minutes // 60}:{minutes % 60:02}:{seconds:02}"
    lost = record.get("train/nonfinite_resets")
    warning = f"  {lost:,.0f} episodes lost (NaN, or absurd)" if lost else ""
    if lost and not record.get("train/episodes"):
        warning += ", and no other has ended: python -m purerl.check EXPERIMENT may say why"
    if record.get("train/episode_length") == 1.0:
        warning += "  every episode ends at its first step: look at terminated"
    rate = f"{steps_per_second:,.0f} steps/s"
    return f"steps {record['steps']:,}  return {shown}{warning}  {rate}  left {left}"


@contextmanager
def progress(updates: int) -> Iterator[_Lines | _Bar]:
    """Yields what shows progress: a live bar on a terminal, plain lines elsewhere.

    It has `say(line)`, and `show(record, seconds_left, steps_per_second)` for each chunk.
    """
    file: Any = output.Guarded(sys.stdout)
    if not file.isatty():
        yield _Lines(updates)
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

    columns = (BarColumn(), TaskProgressColumn(), TextColumn("{task.description}"))
    # Else it takes what is said to standard error, wherever that leads.
    both = output.Guarded(sys.stderr).isatty()
    with Progress(*columns, console=Console(file=file), redirect_stderr=both) as bar:
        yield _Bar(updates, bar)
