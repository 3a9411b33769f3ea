"""Is a run the same on any number of devices, and how fast is it on each?

python -m tests.long.shards 2 -- ant_run --engine jax --ppo.num-envs 8192 --ppo.num-steps 12000000
python -m tests.long.shards 4 -- cartpole_swingup --ppo.num-steps 100000

The first word is the number of shards; what follows `--` is a command line of `purerl.run` without
--num-shards, --name, --runs and --resume. The run is made once on each number of devices that
divides the shards and is there: GPUs if JAX finds any, else virtual devices of the CPU, which share
its cores. A row says how fast it was after its first quarter [control steps/s]; and if it is not
the same as the first one, where they part.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from purerl.report import bit_diff
from purerl.report.run_reader import RunRecord
from tests.long.gpu import run_quietly, speed

FIND = "import jax; print(jax.default_backend(), jax.device_count())"


def main() -> int:
    """Runs the check; exit code 0 if all runs were the same."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        "tests.long.shards", description=__doc__, formatter_class=plain
    )
    parser.add_argument("shards", type=int, help="number of shards")
    parser.add_argument("words", nargs="+", help="-- EXPERIMENT [--option value ...]")
    options = parser.parse_args()
    # In a process of its own: this one shall hold no GPU.
    found = subprocess.check_output([sys.executable, "-c", FIND], text=True).split()
    gpus = int(found[1]) if found[0] == "gpu" else 0
    there = gpus or options.shards
    numbers = [n for n in range(1, there + 1) if options.shards % n == 0]
    if len(numbers) < 2:
        parser.error(
            f"{options.shards} shards and {there} devices leave nothing to compare: the number of "
            "shards must be a multiple of 2, or of another number of devices that are there."
        )
    same = True
    print("{:8} {:>12}  {}".format("devices", "steps/s", "digest"), flush=True)
    with tempfile.TemporaryDirectory() as folder:
        runs = []
        for number in numbers:
            words = [*options.words, "--num-shards", str(options.shards)]
            shown = show(number, gpus > 0, options.shards)
            run = run_quietly(["-m", "purerl.run"], words, Path(folder), f"devices{number}", shown)
            runs.append(run)
            digest = run.lines[-1]["digest"]
            print(f"{number:<8} {speed(run):>12,.0f}  {digest[:16]}", flush=True)
            if figures(run) != figures(runs[0]):
                same = False
                lines = bit_diff.compare_bits(runs[0], run)["lines"]
                print("\n".join(f"  {line}" for line in lines), flush=True)
    return 0 if same else 1


def show(devices: int, on_gpus: bool, most: int) -> dict[str, str]:
    """Returns the environment in which JAX finds so many devices."""
    if on_gpus:
        default = ",".join(map(str, range(devices)))
        shown = os.environ.get("CUDA_VISIBLE_DEVICES", default).split(",")
        return {"CUDA_VISIBLE_DEVICES": ",".join(shown[:devices])}
    # The size of XLA's pool changes bits on a CPU, and it must hold the most devices.
    flags = f"--xla_force_host_platform_device_count={devices}"
    return {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip(), "NPROC": str(most)}


def figures(run: RunRecord) -> list[dict[str, Any]]:
    """Returns a run's metrics and digests without the clock."""
    return [line | {"wall_s": 0} for line in run.lines]


if __name__ == "__main__":
    sys.exit(main())
