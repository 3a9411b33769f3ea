"""Kills a run with SIGKILL at random moments, resumes it, and compares with one left in peace.

python -m tests.long.kills --kills 50 -- cartpole_swingup --ppo.num-steps 60000 --checkpoints 40

What follows `--` is a command line of `python -m purerl.run` without --name, --runs and --resume.
Each of the runs is killed once, at a moment drawn from the seed: a quarter of them while starting
(importing, compiling), the others between the first update and the end, saving and evaluating
included. Then the same command with --resume takes it to its end. A run passes if its
metrics.jsonl, digests of all checkpoints included, is that of the undisturbed run but for the clock
(`wall_s`); with --num-seeds, that of every seed. Exit code 0 if all pass.
"""

import argparse
import collections
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

STARTING = 0.25  # share of the kills that come before the first update


class Undisturbed(NamedTuple):
    """What the run is when nobody disturbs it."""

    lines: list[list[dict]]  # of each seed's metrics.jsonl
    starting: float  # [s] until the first line of metrics.jsonl
    training: float  # [s] from there to the end


class Killed(NamedTuple):
    """How one killed run ended."""

    same: bool
    phase: str  # where the kill met it
    after: int  # updates on the disk when it was killed
    said: str  # by the process that resumed


def main() -> int:
    """Runs the test; returns its exit code."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("tests.long.kills", description=__doc__, formatter_class=plain)
    parser.add_argument("--kills", type=int, default=50, help="runs to kill")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("words", nargs="+", help="-- EXPERIMENT [--option value ...]")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        return 0 if kill_many(options.words, options.kills, options.seed, Path(folder)) else 1


def kill_many(words: list[str], kills: int, seed: int, runs: Path) -> bool:
    """Kills `kills` runs and tells of each; returns whether all ended as the undisturbed one."""
    whole = undisturbed(words, runs)
    times = f"{whole.starting:.1f} s starting, {whole.training:.1f} s training"
    digests = ", ".join(lines[-1]["digest"] for lines in whole.lines)
    print(f"undisturbed: {len(whole.lines[0])} lines, digest {digests}, {times}", flush=True)
    random = np.random.default_rng(seed)
    results: list[Killed] = []
    while len(results) < kills:
        starting = random.random() < STARTING
        moment = random.random() * (whole.starting if starting else whole.training)
        result = kill_once(words, runs, f"kill{len(results)}", whole, starting, moment)
        if result is None:
            continue  # it was done before its moment came
        results.append(result)
        verdict = "same" if result.same else "DIFFERENT"
        print(f"{len(results)}/{kills}  killed {result.phase} with {result.after} updates on the "
              f"disk: {verdict}", flush=True)  # fmt: skip
        if not result.same:
            print(result.said, flush=True)
    phases = collections.Counter(result.phase for result in results)
    passed = sum(result.same for result in results)
    print(f"{passed} of {kills} ended as the undisturbed run; killed: "
          + ", ".join(f"{number} {phase}" for phase, number in sorted(phases.items())))  # fmt: skip
    return passed == kills


def undisturbed(words: list[str], runs: Path) -> Undisturbed:
    """Makes the run without disturbing it."""
    begin = time.monotonic()
    process = spawn(words, runs, "undisturbed")
    wait_for_lines(process, runs, "undisturbed")
    first = time.monotonic()
    said = process.communicate()[0]
    if process.returncode:
        sys.exit(f"The undisturbed run failed with exit code {process.returncode}:\n{said}")
    return Undisturbed(
        read_lines(runs, "undisturbed"), first - begin, time.monotonic() - first
    )  # fmt: skip


def kill_once(
    words: list[str], runs: Path, name: str, whole: Undisturbed, starting: bool, moment: float
) -> Killed | None:
    """Kills a run `moment` [s] after its start or its first line; None if it was already done."""
    process = spawn(words, runs, name)
    if not starting:
        wait_for_lines(process, runs, name)
    time.sleep(moment)
    process.kill()
    process.communicate()
    if process.returncode != -signal.SIGKILL:
        remove(runs, name)
        return None
    phase, after = phase_of(runs, name), max(map(len, read_lines(runs, name)), default=0)
    resume = ["--resume"] if find(runs, name) else []
    process = spawn([*words, *resume], runs, name)
    said = process.communicate()[0]
    same = process.returncode == 0 and read_lines(runs, name) == whole.lines
    if same:
        remove(runs, name)
    return Killed(same, phase, after, said)


def spawn(words: list[str], runs: Path, name: str) -> subprocess.Popen:
    """Starts a run."""
    return subprocess.Popen(
        [sys.executable, "-m", "purerl.run", *words, "--runs", str(runs), "--name", name],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def wait_for_lines(process: subprocess.Popen, runs: Path, name: str) -> None:
    """Waits until the run has measured something, or is over."""
    while not any(read_lines(runs, name)) and process.poll() is None:
        time.sleep(0.01)


def find(runs: Path, name: str) -> list[Path]:
    """Returns the folders of a run's seeds, whatever its experiment is called."""
    return sorted([*runs.glob(f"*/{name}"), *runs.glob(f"*/{name}-seed*")])


def remove(runs: Path, name: str) -> None:
    """Deletes a run."""
    for folder in find(runs, name):
        shutil.rmtree(folder)


def read_lines(runs: Path, name: str) -> list[list[dict]]:
    """Returns the whole lines of each seed's metrics.jsonl, without the clock."""
    files = [folder / "metrics.jsonl" for folder in find(runs, name)]
    texts = [file.read_text().split("\n")[:-1] if file.exists() else [] for file in files]
    return [
        [{k: v for k, v in json.loads(line).items() if k != "wall_s"} for line in lines]
        for lines in texts
    ]


def phase_of(runs: Path, name: str) -> str:
    """Tells from the files what a killed process was doing."""
    folders = find(runs, name)
    if not all((folder / "config.json").exists() for folder in folders) or not folders:
        return "before there was a run"
    if not any((folder / "metrics.jsonl").exists() for folder in folders):
        return "compiling"
    unfinished = [path.name for folder in folders for path in folder.glob("checkpoints/*")]
    unfinished += [path.name for folder in folders for path in folder.glob("checkpoints/.*")]
    if any(name.startswith(".writing") for name in unfinished):
        return "while saving"
    if any(name.startswith(".deleting") for name in unfinished):
        return "while deleting a checkpoint"
    return "between saves"


if __name__ == "__main__":
    sys.exit(main())
