"""Does a run go on under other versions of Python and JAX, and does it say that bits may change?

python -m tests.long.versions /path/to/another/python ...

This interpreter and each of the others begin a run of their own and stop half-way. Every other one
of them is then asked to go on: it has to refuse and name the versions; with --allow-changes, to
find the very values that were saved (their digest) and to end. A row is a pair of interpreters.
Exit code 0 if all do.
"""

import argparse
import itertools
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from purerl.core.errors import USAGE

ROOT = Path(__file__).parents[2]
TOY = "tests/runs/toy_experiment.py"
ABOUT = "import platform, jax; print(platform.python_version(), jax.__version__)"
BEGIN = f"""
import contextlib, itertools, sys
import purerl
from purerl.training import train
asked = itertools.chain([False] * 9, itertools.repeat(True))
train.signals.stop_signals = lambda _: contextlib.nullcontext(lambda: next(asked))
with contextlib.suppress(purerl.StoppedError):
    purerl.train({TOY!r}, runs=sys.argv[1], name="run")
"""


def main(arguments: list[str]) -> int:
    """Runs the check; returns its exit code."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        "tests.long.versions", description=__doc__, formatter_class=plain
    )
    parser.add_argument("pythons", nargs="+", help="other interpreters that can import purerl")
    pythons = [sys.executable, *parser.parse_args(arguments).pythons]
    about = {python: tuple(call(python, "-c", ABOUT).stdout.split()) for python in pythons}
    with tempfile.TemporaryDirectory() as place:
        runs = {python: Path(place) / str(i) for i, python in enumerate(pythons)}
        for python, folder in runs.items():
            call(python, "-c", BEGIN, str(folder)).check_returncode()
        wrong = 0
        for first, then in itertools.permutations(pythons, 2):
            found = go_on(runs[first], then, about[first], about[then])
            wrong += bool(found)
            names = (" with jax ".join(about[python]) for python in (first, then))
            print(" -> ".join(names), "", "; ".join(found) or "as it should", flush=True)
    return 1 if wrong else 0


def go_on(runs: Path, python: str, begun: tuple[str, ...], now: tuple[str, ...]) -> list[str]:
    """Goes on with a copy of a run by another interpreter; returns what is wrong."""
    with tempfile.TemporaryDirectory() as place:
        shutil.copytree(runs, place, dirs_exist_ok=True)
        (folder,) = Path(place).glob("*/run")
        command = ("-m", "purerl.run", TOY, "--runs", place, "--name", "run", "--resume")
        saved = json.loads((folder / "metrics.jsonl").read_text().splitlines()[-1])
        refusal = call(python, *command)
        done = call(python, *command, "--allow-changes")
        manifest = json.loads((folder / "manifest.json").read_text())
        last = json.loads((folder / "metrics.jsonl").read_text().splitlines()[-1])
    pairs = zip(("python", "jax"), begun, now, strict=True)
    changes = [f"versions.{name}: {old} -> {new}" for name, old, new in pairs if old != new]
    noted = manifest.get("allowed_changes", [{"changes": []}])[-1]["changes"]
    resuming = f"Resuming after update {saved['update']}. Digest {saved['digest']}"
    checks = {
        f"it was not refused: {one_line(refusal)}": refusal.returncode == USAGE,
        "a version was not named": all(change in refusal.stderr for change in changes),
        f"it did not end: {one_line(done)}": not done.returncode,
        "the values are others": resuming in done.stdout,
        "the change is not noted": set(changes) <= set(noted),
        "it did not go on": last["update"] > saved["update"],
    }
    return [what for what, right in checks.items() if not right]


def one_line(done: subprocess.CompletedProcess) -> str:
    """Returns the end of what a process said."""
    return " ".join((done.stderr or done.stdout).split())[-200:]


def call(python: str, *words: str) -> subprocess.CompletedProcess:
    """Runs an interpreter in the repository."""
    return subprocess.run([python, *words], cwd=ROOT, capture_output=True, text=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
