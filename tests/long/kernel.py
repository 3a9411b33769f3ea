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

A launch is tried as it is, by XLA's own call ("xla"), and by that of Pallas' Triton ("triton"); the
first that works is taken for the rest. If that is "triton", `launch.by_xla` has to become what
`by_triton` is here. Exit code 0: go, all is right; 1: no-go, and what failed stands in the table.
"""

import argparse
import hashlib
import subprocess
import sys
import time
import traceback
import zlib
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import mlir

from purerl import exact
from purerl.exact.kernel import compilers, compiling, launch
from purerl.exact.kernel.text import Text
from purerl.experiment import command_line
from purerl.experiment.loading import find_source
from purerl.physics import engine_mjx

NUMBERS = (1024, 4096, 8192)  # environments whose rate is measured
BESIDE = 4096  # at which engine `jax`, which takes long to compile, is measured, too
REACHED = 11  # random control steps before states are compared: the ant has fallen on its feet
ROUNDS = 20  # control steps whose time is measured
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


def by_triton(ptx: str, text: Text, blocks: int, block: Any) -> tuple[str, dict[str, Any]]:
    """As `launch.by_xla`: the call of Pallas' Triton; jaxlib compiles the PTX and starts it.

    It adds pointers to scratch memory after the arrays; a kernel that declares none reads none.
    """
    from jax._src.lib import gpu_triton  # JAX has no public way

    size, chip = 4 * text.memory * block.environments, launch.capability()
    warps = block.environments * block.warps
    kernel = gpu_triton.TritonKernel("kernel", warps, 1, size, ptx, "", chip)
    arrays = 1 + len(text.inputs) + len(text.outputs)
    parameters = [gpu_triton.create_array_parameter(0, 4)] * arrays
    call = gpu_triton.TritonKernelCall(kernel, blocks, 1, 1, parameters)
    words = {"name": b"kernel", "opaque": zlib.compress(call.to_proto("kernel", b""))}
    return "triton_kernel_call_ffi", {n: mlir.ir.StringAttr.get(x) for n, x in words.items()}


WAYS = {"xla": launch.by_xla, "triton": by_triton}


def take(way: str) -> None:
    """Launches all kernels in a way from now on."""
    launch.by_xla = WAYS[way]
    jax.clear_caches()


class Subject(NamedTuple):
    """A control step, and where environments start."""

    step: Callable  # (state, ctrl, changes) of one environment, as engine `jax` has it
    exact_step: Callable  # the same with sums in a fixed order, as a training uses it
    start: Callable  # number -> (states, changes) of so many environments
    controls: int  # nu


def subject(experiment: str, words: list[str]) -> Subject:
    """Returns an experiment's physics on engine `jax`."""
    engine_mjx.MOST_OF_A_KERNEL = -1  # what is compared with is XLA's
    chosen, _ = command_line.from_command_line(
        find_source(experiment), [*words, "--engine", "jax"], experiment
    )
    env = chosen.build_env(chosen.env, "jax")

    def step(state: Any, ctrl: Any, changes: dict) -> Any:
        with engine_mjx.mjx_defaults():
            return env.physics._engine.plain_step(state, ctrl, changes)

    def begun(number: jax.Array) -> Any:
        state = env.reset(jax.random.fold_in(jax.random.key(0), number))
        changes = env.model_changes(state) if hasattr(env, "model_changes") else {}
        return state.physics, changes

    # The same for an environment, whatever the number of them.
    start = lambda number: jax.jit(jax.vmap(begun))(jnp.arange(number))  # noqa: E731
    return Subject(step, env.physics.step, start, env.physics.model.nu)


def controls(of: Subject, number: int, seed: int) -> np.ndarray:
    """Returns random controls [number, nu]: the same for an environment whatever the number."""
    draws = [np.random.default_rng([seed, i]).uniform(-1, 1, of.controls) for i in range(number)]
    return np.stack(draws).astype(np.float32)


def stepped(step: Callable) -> Callable:
    """Returns a program of one control step: (states, controls, changes) -> states."""
    return jax.jit(jax.vmap(lambda state, ctrl, changes: step(state, ctrl, changes)[0]))


def repeat(program: Callable, start: Any, ctrl: Any) -> Any:
    """Makes some control steps under one control; returns (states, changes)."""
    state, changes = start
    for _ in range(ROUNDS):
        state = program(state, ctrl, changes)
    return jax.block_until_ready((state, changes))


def rules(way: str) -> str:
    """Compares the kernel of all rules with XLA."""
    from tests.exact.kernel import test_rules as of

    take(way)
    kernel = exact.compile_kernel(of.all_of_them, jax.tree.map(lambda x: x[0], of.INPUTS))
    found = jax.jit(jax.vmap(kernel))(of.INPUTS)
    wanted = jax.jit(jax.vmap(of.all_of_them))(of.INPUTS)
    wrong = []
    for name in of.FUNCTIONS:
        pairs = zip(jax.tree.leaves(found[name]), jax.tree.leaves(wanted[name]), strict=True)
        near = [np.allclose(x, y, 1e-3, 1e-3, equal_nan=True) for x, y in pairs]
        wrong += [f"{name}[{i}]" for i, good in enumerate(near) if not good]
    if wrong:
        raise ValueError(f"{len(wrong)} results are wrong: {', '.join(wrong[:20])}")
    return f"{len(of.FUNCTIONS)} functions, launched by {way}"


def agreement(of: Subject, kernel: Callable, by_xla: Callable) -> compiling.Agreement:
    """Compares a control step with XLA's, on states that XLA has reached."""
    state, changes = of.start(BESIDE)
    for seed in range(REACHED):
        state = by_xla(state, controls(of, BESIDE, seed), changes)
    ctrl = controls(of, BESIDE, REACHED)
    results = [run(state, ctrl, changes) for run in (stepped(kernel), by_xla)]
    flat = [[np.reshape(x, (BESIDE, -1)) for x in jax.tree.leaves(y)] for y in results]
    found = compiling.agreement(*(np.concatenate(x, 1) for x in flat))
    if not found.agrees:
        raise ValueError(f"too far from XLA: {found}")
    return found


def digest(of: Subject, kernel: Callable, number: int, first: int) -> str:
    """Returns the digest of the first environments' states after some control steps."""
    state, _ = repeat(stepped(kernel), of.start(number), controls(of, number, 0))
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


def rate(of: Subject, programs: list[Callable], number: int) -> str:
    """Returns the median rates of programs, in turns [control steps/s]."""
    start, ctrl = of.start(number), controls(of, number, 0)
    start = [repeat(program, start, ctrl) for program in programs][0]
    seconds: list[list[float]] = [[] for _ in programs]
    for _ in range(TURNS):
        for program, taken in zip(programs, seconds, strict=True):
            begin = time.perf_counter()
            repeat(program, start, ctrl)
            taken.append(time.perf_counter() - begin)
    found = [number * ROUNDS / float(np.median(taken)) for taken in seconds]
    spread = [f"{max(x) / min(x):.2f}" for x in seconds]
    said = " and ".join(f"{x:,.0f}" for x in found)
    ratio = f": {found[0] / found[1]:.2f} times" if len(found) > 1 else ""
    return f"{said}{ratio} (spread {', '.join(spread)})"


def main() -> int:
    """Tries all, prints the table."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        "tests.long.kernel", description=__doc__, formatter_class=plain
    )
    parser.add_argument("--experiment", default="ant_run")
    parser.add_argument("--words", nargs=argparse.REMAINDER, default=[], help="of its command line")
    parser.add_argument("--way", choices=WAYS, help="how to launch; else all are tried")
    parser.add_argument("--only-digest", action="store_true", help=argparse.SUPPRESS)
    words = [x for x in sys.argv[1:] if x != "--only-digest"]
    options = parser.parse_args(words)
    exact.set_xla_flags()
    if jax.default_backend() != "gpu":
        sys.exit("JAX finds no GPU. On a CPU, tests/exact/kernel runs the same text.")
    of = subject(options.experiment, options.words)

    def make() -> compiling.Kernel:
        state, changes = jax.tree.map(lambda x: x[0], of.start(1))
        return exact.compile_kernel(of.step, state, np.zeros(of.controls, np.float32), changes)

    if "--only-digest" in sys.argv:
        take(options.way or "xla")
        print(digest(of, make(), NUMBERS[1], NUMBERS[0]))
        return 0
    print(jax.devices()[0].device_kind, "jax", jax.__version__, flush=True)
    ways = [options.way] if options.way else list(WAYS)
    way = next((way for way in ways if tried(f"rules, {way}", partial(rules, way))), ways[0])
    take(way)
    made = tried("step", make, describe)
    if made and tried("ptx", partial(compilers.for_gpu, made.text, launch.capability()), size_of):
        by_xla = stepped(of.exact_step)
        tried("agreement", partial(agreement, of, made, by_xla))
        more = [] if options.way else ["--way", way]
        tried("bits", partial(digests, of, made, [*more, *words]))
        for number in NUMBERS:
            programs = [stepped(made)] + [by_xla] * (number == BESIDE)
            tried(f"rate of {number:,}", partial(rate, of, programs, number))
    print(f"\n{'step':18} {'':7} found")
    for name, how, what in table:
        print(f"{name:18} {how:7} {what}")
    fine = {name for name, how, _ in table if how == "ok"}
    go = {f"rules, {way}", "step", "ptx", "agreement", "bits"} <= fine
    print("go: it launches, agrees and repeats itself" if go else "no-go")
    return 0 if go else 1


def size_of(ptx: str) -> str:
    """Says how long PTX is."""
    return f"{len(ptx):,} bytes"


def describe(kernel: compiling.Kernel) -> str:
    """Says what a kernel needs."""
    text, block = kernel.text, compilers.block_of(kernel.text, launch.capability())
    said = f"{text.statements} statements, {len(text.body):,} characters, "
    return f"{said}{4 * text.memory:,} bytes an environment, {block}"


if __name__ == "__main__":
    sys.exit(main())
