"""Watches memory, file descriptors and threads of a long run with many checkpoints: they are flat.

python -m tests.long.flat [--updates 20000] [--checkpoints 500]

Trains the tests' tiny experiment in a process of its own, and reads /proc four times a second.
Prints the largest values in each quarter of the updates. Exit code 0 if the last quarter has no
more descriptors or threads than the second one, and no more memory but for 2 MB and what
tensorstore 0.1.86 never gives back: 0.25 KB of each `KvStore.Spec(...).to_json()`. Orbax calls it
two or three times for each leaf that it saves.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

TOY = Path(__file__).parent.parent / "runs" / "toy_experiment.py"
STEPS_PER_UPDATE = 32
KEPT_BY_TENSORSTORE = 0.75 / 1024  # [MB] of each leaf at each checkpoint


class Sample(NamedTuple):
    """What a process holds."""

    update: int  # the last one in metrics.jsonl
    megabytes: float  # resident
    descriptors: int
    threads: int


def main() -> int:
    """Runs the check; returns its exit code."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("tests.long.flat", description=__doc__, formatter_class=plain)
    parser.add_argument("--updates", type=int, default=20_000)
    parser.add_argument("--checkpoints", type=int, default=500)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as runs:
        samples = watch(given.updates, given.checkpoints, Path(runs))
        (meta, *_) = Path(runs).glob("*/*/checkpoints/*/meta.json")
        leaves = len(json.loads(meta.read_text())["leaves"])
    quarters = [
        [s for s in samples if i * given.updates // 4 <= s.update < (i + 1) * given.updates // 4]
        for i in range(4)
    ]
    tops = [Sample(*map(max, zip(*quarter, strict=True))) for quarter in quarters]
    for number, top in enumerate(tops, 1):
        print(f"quarter {number}: {top.megabytes:7.1f} MB  {top.descriptors:3} descriptors  "
              f"{top.threads:3} threads  ({len(quarters[number - 1])} samples)")  # fmt: skip
    kept = KEPT_BY_TENSORSTORE * leaves * given.checkpoints / 2
    flat = is_flat(tops[1], tops[3], kept)
    print(f"{'flat' if flat else 'GROWS'}; {kept:.1f} MB are allowed to tensorstore")
    return 0 if flat else 1


def is_flat(early: Sample, late: Sample, kept: float) -> bool:
    """Tells whether the end holds no more than an early part, but for `kept` [MB]."""
    no_more = late.descriptors <= early.descriptors and late.threads <= early.threads
    return no_more and late.megabytes - early.megabytes <= 2 + kept


def watch(updates: int, checkpoints: int, runs: Path) -> list[Sample]:
    """Trains, and returns what was seen meanwhile."""
    words = [TOY, "--runs", runs, "--ppo.num-steps", updates * STEPS_PER_UPDATE, "--log-every", 10]
    words += ["--checkpoints", checkpoints, "--evaluation.number", 20]
    command = [sys.executable, "-m", "purerl.run", *map(str, words)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    metrics = runs / "toy_experiment" / "seed1" / "metrics.jsonl"
    samples = []
    while process.poll() is None:
        time.sleep(0.25)
        if metrics.exists() and metrics.stat().st_size:
            samples += sample(process.pid, metrics)
    if process.returncode:
        sys.exit(f"The run ended with exit code {process.returncode}.")
    return samples


def sample(pid: int, metrics: Path) -> list[Sample]:
    """Reads what a process holds; [] if it has just ended."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
        fields = dict(line.split(":", 1) for line in status.splitlines() if ":" in line)
        descriptors = len(os.listdir(f"/proc/{pid}/fd"))
        resident = int(fields["VmRSS"].split()[0]) / 1024
    except (OSError, KeyError):
        return []
    with metrics.open("rb") as file:
        file.seek(max(metrics.stat().st_size - 10_000, 0))
        lines = file.read().split(b"\n")[:-1]
    return [Sample(json.loads(lines[-1])["update"], resident, descriptors, int(fields["Threads"]))]


if __name__ == "__main__":
    sys.exit(main())
