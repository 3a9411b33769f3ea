"""Stands in for `python -m purerl.run`: folders of its shape, in a tenth of a second, no JAX.

The return is -(ppo.learning-rate - 0.003)^2, the seed's number added. Of ppo.gamma, 0.5 is a
mistake, 0.6 a crash by a signal, 0.7 trains until it is told to stop, and 0.4 is never evaluated.
Where there is a file FAIL it fails.
"""

import argparse
import json
import os
import signal
import sys
import time
from pathlib import Path

parser = argparse.ArgumentParser()
parser.add_argument("experiment")
parser.add_argument("--runs", type=Path)
parser.add_argument("--name")
parser.add_argument("--num-seeds", type=int, default=1)
parser.add_argument("--resume", choices=["auto"])
parser.add_argument("--allow-changes", action="store_true")
parser.add_argument("--ppo.learning-rate", type=float, default=3e-4)
parser.add_argument("--ppo.gamma", type=float, default=0.9)
words = vars(parser.parse_args())
rate, gamma = words["ppo.learning_rate"], words["ppo.gamma"]


def stop(*_):
    print("Stopped after update 1 of 4; it is saved.", flush=True)
    sys.exit(3)


def write(seed: int, update: int) -> None:
    name = words["name"] + (f"-seed{seed}" if words["num_seeds"] > 1 else "")
    folder = words["runs"] / "toy_experiment" / name
    (folder / "checkpoints" / f"{update:012d}").mkdir(parents=True, exist_ok=True)
    ppo = {"num_steps": 4, "num_envs": 1, "rollout_length": 1, "num_minibatches": 1}
    config = {"experiment": "toy_experiment", "settings": {"seed": seed, "ppo": ppo}}
    config["settings"]["ppo"] |= {"learning_rate": rate, "gamma": gamma}
    (folder / "manifest.json").write_text(json.dumps({"run_id": name}))
    (folder / "experiment.py").write_text("")
    value = seed - (rate - 3e-3) ** 2
    line = {"update": update, "steps": update, "train/loss": 1.0}
    line |= {"eval/episode_return": value} if gamma != 0.4 else {}
    with (folder / "metrics.jsonl").open("a") as file:
        file.write(json.dumps(line) + "\n")
    (folder / "config.json").write_text(json.dumps(config))


signal.signal(signal.SIGTERM, stop)
signal.signal(signal.SIGINT, stop)
folders = words["runs"].glob("toy_experiment/*/config.json")
words["resume"] = any(folder.parent.name.startswith(words["name"]) for folder in folders)
print("resumed" if words["resume"] else "begun", os.environ.get("CUDA_VISIBLE_DEVICES"))
print("alone" if os.getpgrp() == os.getpid() else "in the group of its scheduler", flush=True)
if Path("FAIL").exists():
    sys.exit("purerl: A licence server is away.")
if gamma == 0.5:
    sys.exit("purerl: gamma is 0.5.\n  Take another one.")
if gamma == 0.6:
    os.kill(os.getpid(), signal.SIGKILL)
seeds = range(1, words["num_seeds"] + 1)
for seed in seeds:
    write(seed, 1)
end = time.monotonic() + 30
while gamma == 0.7 and not words["resume"] and time.monotonic() < end:
    time.sleep(0.01)
for seed in seeds:
    write(seed, 4)
