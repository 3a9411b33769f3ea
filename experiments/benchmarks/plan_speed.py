"""How fast the planner plans, and what share of that is MuJoCo: a line for each body.

    python -m purerl.experiments.benchmarks.plan_speed
    python -m purerl.experiments.benchmarks.plan_speed ant_gaps --samples 16 64 256 --horizon 25 50

A body moves for some control steps, a plan before each. Then the rows that these plans stepped are
stepped once more, by MuJoCo alone: the same states, actions and changes of the model, none of ours
in between. The share is what MuJoCo alone takes of what the plan took. Engine `c`.
"""

import argparse
import dataclasses
import itertools
import time
from collections.abc import Callable
from typing import Any, NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from purerl.devices.compilation import set_up_jax
from purerl.envs.suite.tasks import TASKS
from purerl.experiment.loading import available
from purerl.experiment.objects import build
from purerl.experiments.benchmarks.output import count
from purerl.experiments.benchmarks.plan_suite import experiment_of
from purerl.machine.command_errors import leave
from purerl.physics import engine_c
from purerl.tune.plan import planner
from purerl.tune.plan.settings import Settings

BODIES = (
    "cartpole-swingup", "cheetah-run", "walker-walk", "hopper-hop", "humanoid-stand", "ant_run",
    "ant_gaps", "rodent_run", "rodent_gaps",
)  # fmt: skip
WARM = 5  # control steps before the ones that are timed


class Speed(NamedTuple):
    """What was measured of one body, with one number of samples and one horizon."""

    plans: float  # [1/s]
    share: float  # of MuJoCo alone
    real_time: float  # simulated seconds in one of the clock

    def words(self, name: str, settings: Settings, side_by_side: int) -> str:
        """Returns a line of the table."""
        rate = self.plans * settings.samples * settings.horizon
        return (
            f"{name:18} {settings.samples:>4} x {settings.horizon:<3} side by side "
            f"{side_by_side:<2} {self.plans:7.1f} plans/s {rate:9,.0f} control steps/s  share "
            f"{self.share:.2f}  {self.real_time:.3f} x real time"
        )


class Recorder:
    """Keeps what the host was asked to step, while `on`."""

    def __init__(self) -> None:
        """Begins with nothing."""
        self.on = False
        self.asked: list[Any] = []
        self.load, self.advance = engine_c._load, engine_c._advance

    def loading(self, targets: Any, rows: np.ndarray, bad: np.ndarray, model: Any) -> None:
        """Loads rows, and keeps a copy."""
        self.last = (targets, rows.copy(), bad, model) if self.on else None
        self.load(targets, rows, bad, model)

    def advancing(self, batch: Any, stage: int, substeps: int) -> np.ndarray:
        """Steps, and keeps how."""
        if self.on and substeps:
            self.asked.append((self.last, (batch, stage, substeps)))
        return self.advance(batch, stage, substeps)

    def alone(self) -> float:
        """Steps all that was kept once more; returns the time in MuJoCo [s]."""
        total = 0.0
        for rows, how in self.asked:
            self.load(*rows)
            begin = time.perf_counter()
            self.advance(*how)
            total += time.perf_counter() - begin
        return total


def measure(name: str, settings: Settings, side_by_side: int, steps: int) -> Speed:
    """Measures one body: E copies of it, side by side, for some control steps."""
    recorder = Recorder()
    with (
        mock.patch.object(engine_c, "_load", recorder.loading),
        mock.patch.object(engine_c, "_advance", recorder.advancing),
    ):
        _, env, _, _ = build(dataclasses.replace(experiment_of(name), engine="c"))
        act = jax.jit(one_step(settings, env))
        keys = jax.random.split(jax.random.key(0), side_by_side)
        state = jax.jit(jax.vmap(env.reset))(keys)
        first = planner.start(settings, env, planner.unguided(env.action_size))
        plan = jax.tree.map(lambda x: jnp.broadcast_to(x, (side_by_side, *x.shape)), first)
        seconds = []
        for step in range(WARM + 2 * steps):
            # Copying the rows takes time: every other plan is timed, and the next one kept.
            recorder.on = step >= WARM and (step - WARM) % 2 == 1
            begin = time.perf_counter()
            plan, state = jax.block_until_ready(act(plan, state, keys, step))
            if step >= WARM and not recorder.on:
                seconds.append(time.perf_counter() - begin)
        mean = float(np.mean(seconds)) / side_by_side
        bare = recorder.alone() / steps / side_by_side
    return Speed(1 / mean, bare / mean, env.control_timestep / mean)


def one_step(settings: Settings, env: Any) -> Callable[..., tuple]:
    """Returns the function that plans and takes one control step in E environments."""
    guide = planner.unguided(env.action_size)

    def act(plan: Any, state: Any, keys: Any, step: Any) -> tuple:
        now = jax.vmap(jax.random.fold_in, (0, None))(keys, step)

        def choose(plan: Any, state: Any, key: Any) -> tuple:
            return planner.plan(settings, env, guide, plan, state, key)

        plan, action = jax.vmap(choose)(plan, state, now)
        return plan, jax.vmap(env.step)(state, action)

    return act


def main() -> int:
    """Prints a line for each body, number of samples and horizon."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        "purerl.experiments.benchmarks.plan_speed", description=__doc__, formatter_class=plain
    )
    known = [*TASKS, *available()]
    parser.add_argument("bodies", nargs="*", metavar="BODY", help="all of the table by default")
    parser.add_argument("--samples", type=int, nargs="+", default=[64])
    parser.add_argument("--horizon", type=int, nargs="+", default=[50])
    parser.add_argument("--side-by-side", type=int, nargs="+", default=[1])
    parser.add_argument("--steps", type=count, default=20, help="control steps that are timed")
    options = parser.parse_args()
    for name in options.bodies:
        if name not in known:
            parser.error(f"{name} is no body; known are {', '.join(known)}")
    set_up_jax(cache=True)
    axes = (options.bodies or BODIES, options.samples, options.horizon, options.side_by_side)
    for name, samples, horizon, number in itertools.product(*axes):
        settings = Settings(samples=samples, horizon=horizon)
        found = measure(name, settings, number, options.steps)
        print(found.words(name, settings, number), flush=True)
    return 0


if __name__ == "__main__":
    leave(main)
