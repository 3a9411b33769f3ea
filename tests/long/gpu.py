"""Is a run the same in two processes on this device, and what do the measures for it cost?

python -m tests.long.gpu -- ant_run --ppo.num-envs 4096 --ppo.num-steps 20000000

What follows `--` is a command line of `python -m purerl.run` without --name, --runs and --resume.
Each variant is run in two processes, one after the other, each with an empty compilation cache. A
row says whether the two have the same digest, and how fast they were after the first quarter of the
run [control steps/s]:

  as it is         nothing set
  autotuning       XLA_FLAGS=--xla_gpu_autotune_level=4, XLA's default: kernels chosen by timing
  deterministic    XLA_FLAGS=--xla_gpu_deterministic_ops=true, XLA's own measure
  no measures      MJX's trace and XLA's choices left as they are, also where ours are faster
  in a chain       kernels of a CUDA graph one after another: the same digest as it is, or a kernel
                   ran before what it needs was there
  no graphs        each kernel started by itself: the same digest, too
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from purerl.report import run_reader
from purerl.report.run_reader import RunRecord

FLAGS = {
    "as it is": "",
    "autotuning": "--xla_gpu_autotune_level=4",
    "deterministic": "--xla_gpu_deterministic_ops=true",
    "no measures": "--xla_gpu_autotune_level=4",
    "in a chain": "--xla_gpu_command_buffer_scheduling_mode=SERIALIZE",
    "no graphs": "--xla_gpu_enable_command_buffer=",
}
EQUAL = ("as it is", "in a chain", "no graphs")  # variants that shall have one digest
# The engine's trace as MJX gives it, without purerl's fixed order of sums.
PLAIN = """
import sys, jax
from purerl import exact
exact.rewrite = lambda f, platform: jax.jit(f, inline=True)
from purerl.run import main
sys.exit(main(sys.argv[1:]))
"""
QUIET = ["--evaluation.number", "0", "--checkpoints", "1"]


class Result(NamedTuple):
    """One process."""

    digest: str
    speed: float  # control steps/s
    exact: bool  # by its own manifest


def main() -> int:
    """Runs the check; exit code 0 if all runs that shall be the same were."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("tests.long.gpu", description=__doc__, formatter_class=plain)
    parser.add_argument("--only", nargs="*", default=list(FLAGS), choices=list(FLAGS))
    parser.add_argument("words", nargs="+", help="-- EXPERIMENT [--option value ...]")
    options = parser.parse_args()
    row = "{:15} {:10} {:>12} {:>12}  {:9} {}"
    print(row.format("variant", "same", "steps/s", "again", "manifest", "digests"), flush=True)
    found: set[str] = set()
    for variant in options.only:
        with tempfile.TemporaryDirectory() as folder:
            first, second = twins(variant, options.words, Path(folder))
        found |= {first.digest, second.digest} if variant in EQUAL else set()
        same = "same" if first.digest == second.digest else "DIFFERENT"
        speeds = [f"{result.speed:,.0f}" for result in (first, second)]
        exact = "exact" if first.exact else "inexact"
        digests = " ".join(sorted({result.digest[:16] for result in (first, second)}))
        print(row.format(variant, same, *speeds, exact, digests), flush=True)
    return 0 if len(found) <= 1 else 1


def twins(variant: str, words: list[str], runs: Path) -> tuple[Result, Result]:
    """Makes a run twice."""
    return make(variant, words, runs, "first"), make(variant, words, runs, "second")


def make(variant: str, words: list[str], runs: Path, name: str) -> Result:
    """Makes a run in a process of its own; ends the check if it fails."""
    program = ["-c", PLAIN] if variant == "no measures" else ["-m", "purerl.run"]
    environment = {
        "JAX_COMPILATION_CACHE_DIR": str(runs / f"cache-{name}"),
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {FLAGS[variant]}".strip(),
    }
    run = run_quietly(program, words, runs, name, environment)
    return Result(run.lines[-1]["digest"], speed(run), run.manifest["bit_exact"])


def run_quietly(
    program: list[str], words: list[str], runs: Path, name: str, environment: dict[str, str]
) -> RunRecord:
    """Makes a run in a process of its own, in so changed an environment; ends all if it fails."""
    done = subprocess.run(
        [sys.executable, *program, *words, *QUIET, "--runs", str(runs), "--name", name],
        env=os.environ | environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    if done.returncode:
        sys.exit(f"The run {name}: exit code {done.returncode}\n{done.stdout}")
    return run_reader.read(next(runs.glob(f"*/{name}")))


def speed(run: RunRecord) -> float:
    """Returns a run's control steps per second after its first quarter."""
    start, end = run.lines[len(run.lines) // 4], run.lines[-1]
    seconds = end["wall_s"] - start["wall_s"]
    return (end["steps"] - start["steps"]) / seconds if seconds else 0.0


if __name__ == "__main__":
    sys.exit(main())
