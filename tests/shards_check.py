"""Is a run the same on any number of devices, and how fast is it on each?

python -m tests.shards_check 2 -- ant_run --engine jax --ppo.num-envs 8192 --ppo.num-steps 12000000
python -m tests.shards_check 4 -- cartpole_swingup --ppo.num-steps 100000

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

from purerl import history, twins
from purerl.history import History

QUIET = ["--evaluation.number", "0", "--checkpoints", "1"]
FIND = "import jax; print(jax.default_backend(), jax.device_count())"


def main() -> int:
    """Runs the check; exit code 0 if all runs were the same."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        "tests.shards_check", description=__doc__, formatter_class=plain
    )
    parser.add_argument("shards", type=int, help="number of shards")
    parser.add_argument("words", nargs="+", help="-- EXPERIMENT [--option value ...]")
    options = parser.parse_args()
    # In a process of its own: this one shall hold no GPU.
    found = subprocess.check_output([sys.executable, "-c", FIND], text=True).split()
    gpus = int(found[1]) if found[0] == "gpu" else 0
    numbers = [n for n in range(1, (gpus or options.shards) + 1) if options.shards % n == 0]
    same = True
    print("{:8} {:>12}  {}".format("devices", "steps/s", "digest"), flush=True)
    with tempfile.TemporaryDirectory() as folder:
        runs = []
        for number in numbers:
            run = make(options.shards, number, gpus > 0, options.words, Path(folder))
            runs.append(run)
            digest = run.lines[-1]["digest"]
            print(f"{number:<8} {speed(run):>12,.0f}  {digest[:16]}", flush=True)
            compared = twins.compare(runs[0], run)
            if not compared.same or compared.parted:
                same = False
                print("\n".join(f"  {line}" for line in compared.lines), flush=True)
    return 0 if same else 1


def make(shards: int, devices: int, on_gpus: bool, words: list[str], runs: Path) -> History:
    """Makes the run on so many devices; ends the check if it fails."""
    name = f"devices{devices}"
    done = subprocess.run(
        [sys.executable, "-m", "purerl.run", *words, *QUIET, "--num-shards", str(shards),
         "--runs", str(runs), "--name", name],
        env=os.environ | show(devices, on_gpus),
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    if done.returncode:
        sys.exit(f"{devices} devices: exit code {done.returncode}\n{done.stdout}")
    return history.read(next(runs.glob(f"*/{name}")))


def show(devices: int, on_gpus: bool) -> dict[str, str]:
    """Returns the environment in which JAX finds so many devices."""
    if on_gpus:
        default = ",".join(map(str, range(devices)))
        shown = os.environ.get("CUDA_VISIBLE_DEVICES", default).split(",")
        return {"CUDA_VISIBLE_DEVICES": ",".join(shown[:devices])}
    # The size of XLA's pool changes bits on a CPU, and it is no smaller than the devices.
    flags = f"--xla_force_host_platform_device_count={devices}"
    return {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip(), "NPROC": "8"}


def speed(run: History) -> float:
    """Returns a run's control steps per second after its first quarter."""
    start, end = run.lines[len(run.lines) // 4], run.lines[-1]
    seconds = end["wall_s"] - start["wall_s"]
    return (end["steps"] - start["steps"]) / seconds if seconds else 0.0


if __name__ == "__main__":
    sys.exit(main())
