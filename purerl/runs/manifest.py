"""The manifest: all that a run's bits depend on besides its settings.

A run writes it down at the start, and `--resume` compares it. A hash of it is in every checkpoint,
with the run's id: they say whose file it is (`Owner`).
"""

import hashlib
import json
import os
import platform
import re
import subprocess
from collections.abc import Callable, Iterable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

from purerl import exact
from purerl.core.errors import UserError
from purerl.devices.threads import cpu_threads
from purerl.experiment.source_hashes import source_hashes

PACKAGES = ["jax", "jaxlib", "mujoco", "mujoco-mjx", "dm-control", "flax", "optax", "numpy"]
PACKAGES += ["orbax-checkpoint"]
INFORMATIVE = {"run_id", "name", "git_revision", "git_dirty", "allowed_changes"}
INFORMATIVE |= {"devices"}  # how many share the shards
INFORMATIVE |= {"fingerprint", "had_checkpoint"}  # below, folder.py
# What these follow from is compared itself.
INFORMATIVE |= {"experiment_file", "bit_exact", "inexact_because"}
FLAGS = ("XLA_FLAGS", "NCCL_ALGO", "NCCL_NVLS_ENABLE")
# Words in the names of JAX's options that move no bit; of all others the value is written down.
HARMLESS = re.compile(
    "cache|check[_s]|cross|debug|devices|dump|guard|log|platform|preemption|timeout|trace"
)
PORTABLE = "x86-64 with AVX2, portable"  # instead of a processor's model


def describe_process(
    engine: str,
    builders: Iterable[Callable],
    kernels: str = "fixed",
    num_shards: int = 1,
    inexact: str = "",
) -> dict[str, Any]:
    """Describes this process: all that decides a run's bits apart from the run's own settings.

    Args:
      engine: the physics engine in use, never "auto".
      builders: functions whose source is part of the run (build_env, build_network).
      kernels: `exact.how_chosen`.
      num_shards: V. How many devices share the shards changes no bit.
      inexact: why the environment itself prevents equal bits; "": it does not.
    """
    import jax

    packages = PACKAGES + (["warp-lang"] if engine == "warp" else [])
    device = jax.devices()[0]
    about = {"platform": device.platform, "kind": _device_kind(device)}
    if device.platform == "cpu":  # XLA's pool size changes the bits of matrix products on a CPU
        about["threads"] = max(cpu_threads(), jax.local_device_count())
    options = sorted(jax.config.values.items())
    return (
        {
            "versions": {"python": platform.python_version(), "libc": "-".join(platform.libc_ver())}
            | {package: metadata.version(package) for package in packages},
            "device": about,
            "num_shards": num_shards,
            "devices": jax.device_count() if num_shards > 1 else 1,
            "engine": engine,
            "kernels": kernels,
            "flags": _flags(),
            "jax": {n: str(x) for n, x in options if not HARMLESS.search(n)},
            "source": source_hashes(builders),
        }
        | exactness(engine, kernels, inexact)
        | _git(Path(__file__).parent)
    )


def exactness(engine: str, kernels: str, inexact: str = "") -> dict[str, Any]:
    """Returns what manifest.json says of a run's exactness, and of what prevents it.

    Args:
      engine: the physics engine.
      kernels: `exact.how_chosen`.
      inexact: why the environment itself prevents it, or "": its member `inexact`.
    """
    reasons = [inexact] if inexact else []
    if engine == "warp":
        reasons.append("engine warp: MJX-Warp adds with atomics, in any order")
    if kernels == "by timing":
        reasons.append(
            "XLA chooses kernels by timing, anew in each process: leave xla_gpu_autotune_level out "
            "of XLA_FLAGS, or set it to 0"
        )
    return {"bit_exact": not reasons, "inexact_because": reasons}


def with_unordered(facts: dict[str, Any], places: Iterable[str]) -> dict[str, Any]:
    """Returns the same once a program for a GPU has shown the sums whose order nothing fixes."""
    reasons = [f"a sum without a fixed order: {place}" for place in places]
    reasons += facts["inexact_because"]
    return {"bit_exact": not reasons, "inexact_because": reasons}


def _flags() -> dict[str, str]:
    """Returns the environment variables that bits depend on, without what says how many devices."""
    found = {name: os.environ[name] for name in FLAGS if name in os.environ}
    if "XLA_FLAGS" in found:
        words = found["XLA_FLAGS"].split()
        found["XLA_FLAGS"] = " ".join(w for w in words if "platform_device_count" not in w)
    return found


def differences(old: Any, new: Any, path: str = "") -> list[str]:
    """Lists where two JSON values differ, as `path: old -> new`, but for INFORMATIVE keys."""
    if isinstance(old, dict) and isinstance(new, dict):
        found = []
        for key in sorted({*old, *new} - (set() if path else INFORMATIVE)):
            values = (old.get(key, "(absent)"), new.get(key, "(absent)"))
            found += differences(*values, f"{path}.{key}" if path else key)
        return found
    return [] if old == new else [f"{path}: {old} -> {new}"]


def count_files(found: Sequence[str], most: int, remark: str = "") -> list[str]:
    """Returns differences with the files of source code as their number, where they are many."""
    files = [line for line in found if line.startswith("source.")]
    if len(files) <= most:
        return list(found)
    return [line for line in found if line not in files] + [f"source: {len(files)} files{remark}"]


def _device_kind(device: Any) -> str:
    """Returns the device's model; for a CPU the processor's, since kernels are chosen by it."""
    portable = exact.is_portable()
    if device.platform != "cpu":
        if portable:
            raise UserError(
                f"Portable bits are a CPU's, and JAX computes on a {device.platform}; set "
                "JAX_PLATFORMS=cpu, or leave out --portable."
            )
        return device.device_kind
    return PORTABLE if portable else processor("model name") or platform.machine()


def processor(what: str) -> str:
    """Returns what Linux says of the processor, "" if it says nothing."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(what)), "")


def was_portable(facts: dict[str, Any]) -> bool:
    """Tells whether the run of a manifest.json was begun with portable bits."""
    device = facts.get("device")
    return isinstance(device, dict) and device.get("kind") == PORTABLE


def _git(folder: Path) -> dict[str, Any]:
    """Returns the revision of the checkout that `folder` is in, None outside of one."""
    words = ["git", "-C", str(folder), "describe", "--always", "--abbrev=40", "--exclude=*"]
    try:
        done = subprocess.run([*words, "--dirty"], capture_output=True, text=True, timeout=10)
        said = done.stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        said = ""
    revision = said.removesuffix("-dirty")
    return {"git_revision": revision or None, "git_dirty": revision != said if said else None}


class Owner(NamedTuple):
    """A run, or an earlier life of it under other conditions."""

    run_id: str
    fingerprint: str
    until: float = float("inf")  # the last update that it trained


def fingerprint(config: dict[str, Any], facts: dict[str, Any], source: bytes) -> str:
    """Returns a sha256 over everything that can change a run's bits.

    Args:
      config: of config.json.
      facts: of manifest.json.
      source: of experiment.py.
    """
    relevant = {key: value for key, value in facts.items() if key not in INFORMATIVE}
    text = json.dumps([config, relevant], sort_keys=True).encode()
    return hashlib.sha256(text + b"\0" + source).hexdigest()


def owners(facts: dict[str, Any]) -> list[Owner]:
    """Returns whose checkpoints a run may hold: its own, and those from before allowed changes."""
    run_id, found = facts["run_id"], [Owner(facts["run_id"], facts["fingerprint"])]
    for change in reversed(facts.get("allowed_changes", [])):
        run_id = change.get("of", {}).get("run_id", run_id)
        found.append(Owner(run_id, change["fingerprint"], change["after_update"]))
    return found


def check_owner(path: Path, meta: dict[str, Any], owners: Sequence[Owner]) -> None:
    """Raises UserError if a checkpoint is of none of `owners` (no owners: of anybody)."""
    run: dict[str, Any] = meta["run"] if isinstance(meta.get("run"), dict) else {}
    ids = run.get("run_id"), run.get("fingerprint")
    same = [owner for owner in owners if (owner.run_id, owner.fingerprint) == ids]
    if not owners or any(meta["update"] <= owner.until for owner in same):
        return
    whose = f"of the run {ids[0]}, seed {run.get('seed')}"
    if ids[0] == owners[0].run_id:
        whose = "of this run under other settings or conditions than it has now"
    raise UserError(
        f"The checkpoint {path} is {whose}; this run is {owners[0].run_id}. It is not used: move "
        "it out of the folder."
    )
