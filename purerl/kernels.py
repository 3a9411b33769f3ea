"""Keeps the kernels that XLA chose for a run, so that a resumed one computes with the same.

On a GPU, XLA times several kernels for an operation and takes the fastest. Two processes may choose
differently, and other kernels add in another order. JAX keeps the choices in a folder inside its
compilation cache; a copy of them goes with the run, to be used where that cache does not reach.
"""

import os
import shutil
from pathlib import Path

CHOICES = "xla_gpu_per_fusion_autotune_cache_dir"  # JAX's name for the folder
KEPT = "kernels"  # in the run's folder
FIXING_FLAGS = (
    "xla_gpu_autotune_level=0",
    "xla_gpu_deterministic_ops=true",
    "xla_gpu_exclude_nondeterministic_ops=true",
)


def how_chosen(platform: str, cache: bool) -> str:
    """Tells how kernels are chosen: "fixed", "kept with the run", or "anew in each process"."""
    flags = os.environ.get("XLA_FLAGS", "")
    if platform != "gpu" or any(flag in flags for flag in FIXING_FLAGS):
        return "fixed"
    return "kept with the run" if cache else "anew in each process"


def bring(run: Path, cache: str) -> None:
    """Puts what a run chose where JAX looks for it; what is there already stays."""
    _copy_missing(run / KEPT, Path(cache) / CHOICES)


def keep(run: Path, cache: str) -> None:
    """Puts what was chosen beside the run."""
    _copy_missing(Path(cache) / CHOICES, run / KEPT)


def _copy_missing(source: Path, target: Path) -> None:
    for file in sorted(source.rglob("*")) if source.is_dir() else ():
        copy = target / file.relative_to(source)
        if file.is_file() and not copy.exists():
            copy.parent.mkdir(parents=True, exist_ok=True)
            draft = copy.with_name(f".{copy.name}.draft")  # others may be reading the folder
            shutil.copyfile(file, draft)
            draft.replace(copy)
