"""Computes the golden digests; exits with 1 if one is not that of digests.json."""

import argparse
import contextlib
import hashlib
import io
import json
import os
import sys
import tempfile
from pathlib import Path

os.environ["JAX_PLATFORMS"] = "cpu"

import numpy as np  # noqa: E402

from purerl import run  # noqa: E402

HERE = Path(__file__).parent
TABLE = HERE / "digests.json"
EXPERIMENTS = HERE.parent.parent / "experiments"
FEW = "--ppo.num-steps 768 --ppo.num-envs 16 --ppo.rollout-length 16 --ppo.episode-length 20"
FEW += " --ppo.num-minibatches 4 --evaluation.number 1 --evaluation.num-episodes 4"
TINY = FEW.replace("768", "128").replace("-length 16", "-length 4").replace("-envs 16", "-envs 8")
# Name -> experiment and options. `ant_jax` compiles for a minute.
RUNS = {
    "cartpole": (EXPERIMENTS / "cartpole_swingup.py", FEW),
    "recurrent": (HERE / "recurrent.py", ""),
    "dict_observation": (HERE / "privileged.py", ""),
    "four_shards": (EXPERIMENTS / "cartpole_swingup.py", f"{FEW} --num-shards 4"),
    "seeing_shards": (HERE / "seeing.py", "--num-shards 2"),
    "vmapped_seeds": (EXPERIMENTS / "cartpole_swingup.py", f"{FEW} --num-seeds 2"),
    "ant_c": (EXPERIMENTS / "ant_run.py", f"{FEW} --engine c"),
    "ant_jax": (EXPERIMENTS / "ant_run.py", f"{TINY} --engine jax"),
}


def of_run(experiment: Path, options: str, runs: Path) -> dict[str, str]:
    """Trains; returns the digest of the last state, and that of all metrics, the clock aside."""
    said = io.StringIO()
    words = [str(experiment), *options.split(), "--checkpoints", "1", "--runs", str(runs)]
    words.append("--portable")
    with contextlib.redirect_stdout(said):
        code = run.main(words)
    assert code == 0, said.getvalue()
    files = sorted(runs.glob("*/*/metrics.jsonl"))
    lines = [json.loads(line) for file in files for line in file.read_text().splitlines()]
    told = [{k: v for k, v in line.items() if k not in ("wall_s", "digest")} for line in lines]
    digests = [line["digest"] for line in lines if "digest" in line]
    return {"state": sha256("".join(digests)), "metrics": sha256(json.dumps(told, sort_keys=True))}


def of_statistics() -> dict[str, str]:
    """Computes what `compare` says of scores."""
    from purerl.report import bootstrap

    x = [np.sin(np.arange(12.0)), np.cos(np.arange(7.0))]
    y = [np.sin(np.arange(3.0, 15.0)), np.cos(np.arange(2.0, 9.0))]
    found = {
        "interval": bootstrap.iqm_interval(x),
        "difference": bootstrap.difference_interval(x, y),
        "improvement": bootstrap.improvement_interval(x, y),
        "band": [list(map(float, row)) for row in bootstrap.curve_band([np.outer(x[0], y[0])])],
    }
    return {"intervals": sha256(json.dumps(found))}


def sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def compute(names: list[str]) -> dict[str, dict[str, str]]:
    """Returns name -> what is digested -> digest."""
    found = {}
    for name in names:
        with tempfile.TemporaryDirectory() as runs:
            one = of_run(*RUNS[name], Path(runs)) if name in RUNS else of_statistics()
        found[name] = one
    return found


def main() -> int:
    """Runs the command."""
    parser = argparse.ArgumentParser(prog="python -m tests.golden", description=__doc__)
    every = [*RUNS, "statistics"]
    parser.add_argument("names", nargs="*", help=", ".join(every))
    parser.add_argument("--write", action="store_true", help="put them into digests.json")
    given = parser.parse_args()
    if unknown := [name for name in given.names if name not in every]:
        parser.error(f"{unknown[0]} is not one of {', '.join(every)}.")
    found = compute(given.names or every)
    known = json.loads(TABLE.read_text()) if TABLE.exists() else {}
    parted = [name for name, one in found.items() if known.get(name) != one]
    for name, one in found.items():
        print(name, "differs:" if name in parted else "same", json.dumps(one))
    if given.write:
        TABLE.write_text(json.dumps(known | found, indent=2) + "\n")
        return 0
    return 1 if parted else 0


if __name__ == "__main__":
    sys.exit(main())
