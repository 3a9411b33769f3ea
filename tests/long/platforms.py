"""Does this machine's GPU compute what a CPU computes?

python -m tests.long.platforms ant_run --engine jax --ppo.num-envs 256 --ppo.rollout-length 16

One process computes on a CPU: a beginning, a rollout, a control step under random actions from
where that ended, and what is learned of it. Another does the step and the learning on JAX's default
device from the same arrays. A row is an array that differs: by how much at most, relative to its
greatest entry (at least 1). Exit code 1 if a difference is above the limit. Networks multiply in
whole float32, unless JAX_DEFAULT_MATMUL_PRECISION says otherwise.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import jax
import numpy as np

from purerl import exact
from purerl.core.records import PyTree
from purerl.experiment import command_line, objects
from purerl.experiment.loading import find_source
from purerl.experiment.objects import Setup
from purerl.machine import state_arrays
from purerl.machine.command_errors import leave
from purerl.ppo import algorithm

ROWS = 12  # shown


def main(arguments: list[str]) -> int:
    """Runs the check; returns its exit code."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        "tests.long.platforms", description=__doc__, formatter_class=plain
    )
    parser.add_argument("experiment", help="as for python -m purerl.run, with its overrides")
    parser.add_argument("--limit", type=float, default=1e-3, help="of relative differences")
    parser.add_argument("--write", default="", help="compute here, and write to this file instead")
    options, overrides = parser.parse_known_args(arguments)
    exact.set_xla_flags()
    precision = os.environ.get("JAX_DEFAULT_MATMUL_PRECISION", "highest")
    jax.config.update("jax_default_matmul_precision", precision)
    prog = f"python -m tests.long.platforms {options.experiment}"
    experiment, _ = command_line.from_command_line(find_source(options.experiment), overrides, prog)
    setup = objects.build(experiment)
    if options.write:
        np.savez(options.write, **state_arrays.flatten(make(setup)))
        return 0
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "there.npz"
        ask_cpu([options.experiment, *overrides, "--write", str(file)])
        there = dict(np.load(file))
    differences = compare(setup, there)
    for path, apart in sorted(differences.items(), key=lambda row: -row[1])[:ROWS]:
        print(f"{apart:9.1e}  {path}")
    above = [apart for apart in differences.values() if not apart <= options.limit]  # NaN is, too
    device = jax.devices()[0].device_kind
    print(f"{len(differences)} arrays differ on {device}, {len(above)} above {options.limit:g}")
    return 1 if above else 0


def ask_cpu(words: list[str]) -> None:
    """Has a process compute on the CPU."""
    # On two of XLA's threads, MJX's factorisations can wait for each other for ever.
    threads = os.environ.get("NPROC", "1")
    subprocess.run(
        [sys.executable, "-m", "tests.long.platforms", *words],
        env=os.environ | {"JAX_PLATFORMS": "cpu", "NPROC": threads}, check=True,
    )  # fmt: skip


def make(setup: Setup) -> dict[str, PyTree]:
    """Returns what is given to both, and what is found here."""
    config, env, network, _ = setup
    key = jax.random.key(0)
    begin = jax.jit(partial(algorithm.init, config, env, network))(key)
    state, experience = jax.jit(partial(algorithm.collect, config, env, network))(begin)
    shape = (config.num_envs, env.action_size)
    action = jax.random.uniform(jax.random.fold_in(key, 1), shape, minval=-1.0, maxval=1.0)
    given = {"state": state, "experience": experience, "action": action}
    return {"given": given, "found": compute(setup, given)}


def compute(setup: Setup, given: dict[str, PyTree]) -> dict[str, PyTree]:
    """Returns where a control step ends, and the parameters and metrics of what is learned."""
    config, env, network, _ = setup
    state = given["state"]
    step = jax.jit(jax.vmap(env.step))(state.env_state, given["action"])
    learned, metrics = jax.jit(partial(algorithm.improve, config, network))(
        state, given["experience"]
    )
    return {"step": step, "params": learned.params, "metrics": metrics}


def compare(setup: Setup, there: dict[str, np.ndarray]) -> dict[str, float]:
    """Returns the greatest difference of each array found there that is another here."""
    whole = state_arrays.unflatten(there, jax.eval_shape(partial(make, setup)))
    here = state_arrays.flatten({"found": compute(setup, whole["given"])})
    return {
        path: difference(array, there[path])
        for path, array in here.items()
        if not np.array_equal(array, there[path], equal_nan=array.dtype.kind == "f")
    }


def difference(here: np.ndarray, there: np.ndarray) -> float:
    """Returns the greatest difference, relative to the greatest entry, at least 1."""
    a, b = (x.astype(np.float64) for x in (here, there))
    return float(np.abs(a - b).max() / max(1.0, np.abs(b).max()))


if __name__ == "__main__":
    leave(lambda: main(sys.argv[1:]))
