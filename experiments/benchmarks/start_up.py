"""How long a start takes: from the command to the first update, with an empty cache and a full one.

    python -m purerl.experiments.benchmarks.start_up cartpole_swingup ant_run --engines c jax
    python -m purerl.experiments.benchmarks.start_up ant_run --engines jax --ppo.num-envs 4096

Each start is `python -m purerl.run` in a process of its own, ended after its first update. The
first start finds an empty compilation cache, the second one the cache that the first filled.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from purerl.core.errors import UserError
from purerl.machine.command_errors import leave

LIMIT_S = 900.0


class Start(NamedTuple):
    """One start, in seconds after the command."""

    experiment: str
    engine: str
    cache: str
    planned: float  # imports done, environment and network built, the plan printed
    compiled: float
    first_update: float
    cpu: float  # processor time until then: what the start would take alone, on one core
    compile_times: dict[str, float]  # as the run reports them [s]


def command(experiment: str, engine: str, overrides: list[str], runs: Path) -> list[str]:
    """Returns the command of a run that writes a line after each update."""
    options = ["--engine", engine, "--runs", str(runs), "--name", "one", "--log-every", "1"]
    return [sys.executable, "-m", "purerl.run", experiment, *options, *overrides]


def start(experiment: str, engine: str, overrides: list[str], cache: Path, state: str) -> Start:
    """Starts a run, waits for its first update, and ends it."""
    with tempfile.TemporaryDirectory() as folder:
        words = command(experiment, engine, overrides, Path(folder))
        begin = time.perf_counter()
        process = subprocess.Popen(
            words,
            env=os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache)},
            stdout=(Path(folder) / "output").open("w"),
            stderr=subprocess.STDOUT,
        )
        try:
            return watch(process, Path(folder), begin)._replace(
                experiment=experiment, engine=engine, cache=state
            )
        finally:
            process.kill()
            process.wait()


def watch(process: subprocess.Popen, folder: Path, begin: float) -> Start:
    """Notes when the plan, the compile times and the first line of metrics appear."""
    seen: dict[str, float] = {}
    while "update" not in seen:
        time.sleep(0.01)
        now = time.perf_counter() - begin
        text = (folder / "output").read_text()
        written = {
            "plan": "bit-exact" in text,
            "compiled": "Compiled: " in text,
            "update": any(path.stat().st_size for path in folder.glob("*/one/metrics.jsonl")),
        }
        seen = {name: now for name, done in written.items() if done} | seen
        if process.poll() is not None or now > LIMIT_S:
            last = " ".join(text.split("\n")[-2:]).strip()
            raise UserError(f"The run ended, or took {LIMIT_S:.0f} s, before its update: {last}")
    times = seen["plan"], seen["compiled"], seen["update"], cpu_seconds(process.pid)
    return Start("", "", "", *times, compile_times(text))


def cpu_seconds(process_id: int) -> float:
    """Returns the processor time that a process has taken [s], from Linux's /proc."""
    # The second field is the command in brackets, and may hold spaces.
    fields = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def compile_times(output: str) -> dict[str, float]:
    """Reads a run's line "Compiled: collect 3.2 s, init 0.9 s"."""
    line = re.search(r"Compiled: (.*)", output)
    found = re.findall(r"(\w+) ([\d.]+) s", line[1] if line else "")
    return {name: float(seconds) for name, seconds in found}


def both_starts(experiment: str, engine: str, overrides: list[str]) -> list[Start]:
    """Starts with an empty cache, then with a full one."""
    with tempfile.TemporaryDirectory() as cache:
        return [
            start(experiment, engine, overrides, Path(cache), state) for state in ("cold", "warm")
        ]


def help_seconds() -> float:
    """Returns the time of `python -m purerl.run --help` [s], the better of two."""
    taken = []
    for _ in range(2):
        begin = time.perf_counter()
        help_command = [sys.executable, "-m", "purerl.run", "--help"]
        subprocess.run(help_command, check=True, stdout=subprocess.DEVNULL)
        taken.append(time.perf_counter() - begin)
    return min(taken)


def table(starts: list[Start]) -> str:
    """Formats starts; the last column is what the run says of its compiling."""
    lines = [
        "| experiment | engine | cache | plan [s] | compiled [s] | first update [s] | CPU [s] "
        "| of which |"
    ]
    lines.append("|---|---|---|---|---|---|---|---|")
    for s in starts:
        parts = ", ".join(f"{name} {seconds:.1f}" for name, seconds in s.compile_times.items())
        lines.append(
            f"| {s.experiment} | {s.engine} | {s.cache} | {s.planned:.1f} | {s.compiled:.1f} "
            f"| {s.first_update:.1f} | {s.cpu:.1f} | {parts} |"
        )
    return "\n".join(lines)


def main(arguments: list[str]) -> int:
    """Measures the experiments and engines that the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("experiments", nargs="+", help="as for python -m purerl.run")
    parser.add_argument("--engines", nargs="+", default=["auto"], help="engines to start with")
    options, overrides = parser.parse_known_args(arguments)
    pairs = [(name, engine) for name in options.experiments for engine in options.engines]
    starts = [s for pair in pairs for s in both_starts(*pair, overrides)]
    print(f"{table(starts)}\npython -m purerl.run --help: {help_seconds():.2f} s")
    return 0


if __name__ == "__main__":
    leave(lambda: main(sys.argv[1:]))
