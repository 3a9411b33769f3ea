"""Is each policy that comes with purerl the one that its command trains again, bit for bit?

python -m tests.long.policies                     # all: an hour
python -m tests.long.policies cartpole_swingup    # half a minute

It needs the processor and the versions that the policy's manifest.json names. Elsewhere the digest
may be another, and the line says what differs; then the returns of both are what can be compared.
"""

import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

import purerl
from purerl.experiment.loading import POLICIES
from purerl.experiments.benchmarks.policies import training_command
from purerl.runs import manifest
from purerl.runs.folder import read_run


def main(names: list[str]) -> int:
    """Trains them, and prints a line for each; returns the exit code."""
    found = {}
    for name in names or sorted(place.name for place in POLICIES.iterdir()):
        found[name] = again(POLICIES / name)
        print(f"{name}: {found[name] or 'the same digest'}", flush=True)
    return int(any(found.values()))


def again(policy: Path) -> str:
    """Trains a policy again; returns what is not the same, "" if nothing."""
    shipped = read_run(policy)
    with tempfile.TemporaryDirectory() as place:
        words = [*shlex.split(training_command(shipped))[1:], "--runs", place, "--name", "again"]
        subprocess.run([sys.executable, *words], check=True, stdout=subprocess.DEVNULL)
        folder = Path(place) / shipped.config["experiment"] / "again"
        runs = [purerl.load(path) for path in (policy, folder)]
        if runs[0].digest == runs[1].digest:
            return ""
        last = [run.metrics()["eval/episode_return"][-1] for run in runs]
        parts = manifest.differences(shipped.manifest, read_run(folder).manifest)
        differs = "; ".join(manifest.count_files(parts, 3)) or "nothing"
        digests = f"digest {runs[1].digest}, not {runs[0].digest}"
        return f"{digests}; return {last[1]:.2f}, not {last[0]:.2f}; what differs: {differs}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
