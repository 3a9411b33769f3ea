"""Does a control step as one kernel run on this GPU, is it right, always the same, and how fast?

python -m tests.long.kernel
python -m tests.long.kernel --experiment suite --words --env.task cheetah-run

It needs NVRTC (`pip install 'jax[cuda13]'` brings it). Each step is tried by itself: what fails is
printed, and the next one is tried where that makes sense. In this order:

  rules      every rule of `purerl/exact/kernel`, as one kernel, beside XLA on this GPU
  step       the experiment's control step: traced, written, compiled
  agreement  with XLA's own step, on states that XLA has reached
  bits       one digest in two processes, and of 1,024 environments alone and among 4,096
  rate       control steps/s of physics alone beside engine `jax`, in turns

A launch is tried in each way there is ("xla", "triton"), and the first that works is taken for the
rest. Exit code 0: go, all is right; 1: no-go, and what failed stands in the table.
"""

import argparse
import hashlib
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from purerl import exact
from purerl.exact.kernel import compilers, compiling, launch
from purerl.experiment import command_line
from purerl.experiment.loading import find_source
from purerl.physics.engine_mjx import mjx_defaults

NUMBERS = (1024, 4096, 8192)  # environments whose rate is measured
REACHED = 11  # random control steps before states are compared: the ant has fallen on its feet
COMPARED = 256  # environments
ROUNDS = 20  # control steps of one program whose time is measured
TURNS = 5
table: list[tuple[str, str, str]] = []  # step, "ok" or "FAILED", what was found


def tried(name: str, job: Callable[[], Any], say: Callable[[Any], str] = str) -> Any:
    """Runs one step; returns its result, or None if it failed, and prints which."""
    begin = time.perf_counter()
    try:
        found = job()
        row = name, "ok", say(found)
    except Exception as error:
        found, lines = None, str(error).strip().splitlines() or [""]
        row = name, "FAILED", f"{type(error).__name__}: {lines[0][:300]}"
        traceback.print_exc(limit=-4)
    table.append(row)
    print(f"{time.perf_counter() - begin:7.1f} s  {'  '.join(row)}", flush=True)
    return found


class Subject(NamedTuple):
    """A control step, and what it is called with."""

    step: Callable  # (state, ctrl, changes) of one environment, as engine `jax` has it
    exact_step: Callable  # the same with sums in a fixed order, as a training uses it
    state: Any
    ctrl: np.ndarray  # [nu]


def subject(experiment: str, words: list[str]) -> Subject:
    """Returns an experiment's physics on engine `jax`."""
    chosen, _ = command_line.from_command_line(
        find_source(experiment), [*words, "--engine", "jax"], experiment
    )
    physics = chosen.build_env(chosen.env, "jax").physics

    def step(state: Any, ctrl: Any, changes: dict) -> Any:
        with mjx_defaults():
            return physics._engine.plain_step(state, ctrl, changes)

    qpos = jnp.asarray(physics.model.qpos0, jnp.float32)
    state = jax.jit(physics.init)(qpos, jnp.zeros(physics.model.nv))[0]
    return Subject(step, physics.step, state, np.zeros(physics.model.nu, np.float32))


def controls(of: Subject, number: int, seed: int) -> np.ndarray:
    """Returns random controls [number, nu]: the same for an environment whatever the number."""
    draw = [np.random.default_rng([seed, i]).uniform(-1, 1, of.ctrl.shape) for i in range(number)]
    return np.stack(draw).astype(np.float32)


def repeated(of: Subject, number: int) -> Any:
    """Returns the first state for each of so many environments."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (number, *x.shape)), of.state)


def stepped(step: Callable, rounds: int) -> Callable:
    """Returns a program of control steps under one control: (state, ctrl) -> state."""

    def run(state: Any, ctrl: Any) -> Any:
        each = jax.vmap(lambda s, c: step(s, c, {})[0])
        return jax.lax.scan(lambda s, _: (each(s, ctrl), None), state, None, rounds)[0]

    return jax.jit(run)


def rules(target: str) -> str:
    """Compares the kernel of all rules with XLA."""
    from tests.exact.kernel import test_rules as of

    kernel = exact.compile_kernel(of.all_of_them, jax.tree.map(lambda x: x[0], of.INPUTS))
    found = jax.jit(jax.vmap(partial(kernel, target=target)))(of.INPUTS)
    wanted = jax.jit(jax.vmap(of.all_of_them))(of.INPUTS)
    wrong = []
    for name in of.FUNCTIONS:
        pairs = zip(jax.tree.leaves(found[name]), jax.tree.leaves(wanted[name]), strict=True)
        near = [np.allclose(x, y, 1e-3, 1e-3, equal_nan=True) for x, y in pairs]
        wrong += [f"{name}[{i}]" for i, good in enumerate(near) if not good]
    if wrong:
        raise ValueError(f"{len(wrong)} results are wrong: {', '.join(wrong[:20])}")
    return f"{len(of.FUNCTIONS)} functions, launched by {target}"


def agreement(of: Subject, kernel: Callable) -> compiling.Agreement:
    """Compares a control step with XLA's, on states that XLA has reached."""
    state, by_xla = repeated(of, COMPARED), stepped(of.exact_step, 1)
    for seed in range(REACHED):
        state = by_xla(state, controls(of, COMPARED, seed))
    ctrl = controls(of, COMPARED, REACHED)
    results = [run(state, ctrl) for run in (stepped(kernel, 1), by_xla)]
    flat = [[np.reshape(x, (COMPARED, -1)) for x in jax.tree.leaves(y)] for y in results]
    found = compiling.agreement(*(np.concatenate(x, 1) for x in flat))
    if not found.agrees:
        raise ValueError(f"too far from XLA: {found}")
    return found


def digest(of: Subject, kernel: Callable, number: int, first: int) -> str:
    """Returns the digest of the first environments' states after some control steps."""
    state = stepped(kernel, ROUNDS)(repeated(of, number), controls(of, number, 0))
    rows = [np.asarray(x)[:first].tobytes() for x in jax.tree.leaves(state)]
    return hashlib.sha256(b"".join(rows)).hexdigest()[:16]


def digests(of: Subject, kernel: Callable, words: list[str]) -> str:
    """Compares digests: here twice, among more environments, and of another process."""
    first, most = NUMBERS[:2]
    found = {f"of {n:,}": digest(of, kernel, n, first) for n in (first, most)}
    found["again"] = digest(of, kernel, most, first)
    other = [sys.executable, "-m", "tests.long.kernel", *words, "--only-digest"]
    done = subprocess.run(other, capture_output=True, text=True)
    found["another process"] = (done.stdout.split() or [done.stderr[-300:]])[-1]
    if len(set(found.values())) > 1:
        raise ValueError(f"they differ: {found}")
    return f"{found['again']} in all of {', '.join(found)}"


def rates(of: Subject, kernel: Callable, number: int) -> str:
    """Returns the median rates of the kernel and of engine `jax`, in turns [control steps/s]."""
    state, ctrl = repeated(of, number), controls(of, number, 0)
    programs = [stepped(step, ROUNDS) for step in (kernel, of.exact_step)]
    state = jax.block_until_ready(programs[0](state, ctrl))
    jax.block_until_ready(programs[1](state, ctrl))
    seconds: list[list[float]] = [[], []]
    for _ in range(TURNS):
        for program, taken in zip(programs, seconds, strict=True):
            begin = time.perf_counter()
            jax.block_until_ready(program(state, ctrl))
            taken.append(time.perf_counter() - begin)
    ours, theirs = (number * ROUNDS / float(np.median(taken)) for taken in seconds)
    spread = [f"{max(x) / min(x):.2f}" for x in seconds]
    return f"{ours:,.0f} and {theirs:,.0f}: {ours / theirs:.2f} times (spread {', '.join(spread)})"


def main() -> int:
    """Tries all, prints the table."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        "tests.long.kernel", description=__doc__, formatter_class=plain
    )
    parser.add_argument("--experiment", default="ant_run")
    parser.add_argument("--words", nargs=argparse.REMAINDER, default=[], help="of its command line")
    parser.add_argument(
        "--target", choices=launch.TARGETS, help="how to launch; else all are tried"
    )
    parser.add_argument("--only-digest", action="store_true", help=argparse.SUPPRESS)
    words = [x for x in sys.argv[1:] if x != "--only-digest"]
    options = parser.parse_args(words)
    exact.set_xla_flags()
    if jax.default_backend() != "gpu":
        sys.exit("JAX finds no GPU. On a CPU, tests/exact/kernel runs the same text.")
    of = subject(options.experiment, options.words)
    make = lambda: exact.compile_kernel(of.step, of.state, of.ctrl, {})  # noqa: E731
    if "--only-digest" in sys.argv:
        kernel = partial(make(), target=options.target or launch.TARGETS[0])
        print(digest(of, kernel, NUMBERS[1], NUMBERS[0]))
        return 0
    print(jax.devices()[0].device_kind, "jax", jax.__version__, flush=True)
    ways = [options.target] if options.target else launch.TARGETS
    working = [way for way in ways if tried(f"rules, {way}", partial(rules, way))]
    made = tried("step", make, describe)
    if made and tried(
        "ptx",
        lambda: compilers.for_gpu(made.text, launch.capability()),
        lambda x: f"{len(x):,} bytes",
    ):
        way = (working or ways)[0]
        kernel = partial(made, target=way)
        tried("agreement", partial(agreement, of, kernel))
        more = [] if options.target else ["--target", way]
        tried("bits", partial(digests, of, kernel, [*more, *words]))
        for number in NUMBERS:
            tried(f"rate of {number:,}", partial(rates, of, kernel, number))
    print(f"\n{'step':18} {'':7} found")
    for name, how, what in table:
        print(f"{name:18} {how:7} {what}")
    needed = {name: how for name, how, _ in table if not name.startswith("rules")}
    go = working and {"step", "ptx", "agreement", "bits"} <= {
        n for n, how in needed.items() if how == "ok"
    }
    print("go: it launches, agrees and repeats itself" if go else "no-go")
    return 0 if go else 1


def describe(kernel: compiling.Kernel) -> str:
    """Says what a kernel needs."""
    text, block = kernel.text, compilers.environments_of(kernel.text, launch.capability())
    return (f"{text.statements} statements, {len(text.body):,} characters, {4 * text.memory:,} bytes "
            f"an environment, {block} of them a block")  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
