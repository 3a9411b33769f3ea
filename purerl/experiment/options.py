"""Options of commands: how a run is made, kept and shown, and how its policy is played."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypedDict

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from purerl.core.errors import UserError, check_least

Engine = Literal["auto", "c", "jax", "warp"]
UNITS = r"all|\d+(-\d+)?(,\d+(-\d+)?)*"


def check_seed(seed: int) -> None:
    """Raises UserError for a seed that JAX would take for another one: it keeps 32 bits."""
    if not 0 <= seed < 2**32:
        raise UserError(f"seed is {seed}; it must be at least 0 and below 2**32.")


def read_resume(words: list[str]) -> bool | Literal["auto"]:
    """Returns what the words behind `--resume` mean: none, auto, or Python's True and False."""
    if words not in ([], ["auto"], ["True"], ["False"]):
        raise ValueError(f"resume is {' '.join(words)!r}; write --resume, or --resume auto.")
    return "auto" if words == ["auto"] else words != ["False"]


Resume = bool | Literal["auto"]
RESUME = PrimitiveConstructorSpec(
    "*", "[auto]", read_resume, lambda value: value in (True, False, "auto"), lambda value: []
)


@dataclass(frozen=True)
class EpisodeOptions:
    """Which episodes are played, and from which checkpoint."""

    checkpoint: str = "latest"
    """Of a run: latest, best (highest evaluation return), or an update's number."""
    seed: int = 0
    """Seed of the episodes, and of all else that is drawn; never meets a seed of training."""
    trust: bool = False
    """Execute the run's experiment.py though this machine does not know it: read it first."""

    def __post_init__(self) -> None:
        """Checks the rules."""
        check_seed(self.seed)


@dataclass(frozen=True)
class PlayOptions(EpisodeOptions):
    """Which run's policy is played, and where."""

    run: Annotated[Path, tyro.conf.Positional] = field(kw_only=True)
    """The run's folder, such as runs/ant_run/seed1, or ant_gaps, which comes with purerl."""
    engine: Literal["", Engine] = ""
    """Physics engine, where it should not be the run's own."""


@dataclass(frozen=True)
class Lesion:
    """What is done to units of a network while it acts."""

    layer: tuple[str, ...] = ()
    """Layers, called as by `record` but for network/, such as policy/Dense_0; none: no lesion."""
    kind: Literal["silence", "noise", "clamp"] = "silence"
    """silence: activity times 1 - strength; noise: plus normal noise with the deviation strength;
    clamp: the activity is strength."""
    strength: float = 1.0
    """How much, in the sense of kind."""
    units: str = "all"
    """Which of each layer's units, such as 0-15,20."""
    share: float = 1.0
    """Of these, drawn by --seed; a greater share has the units of a smaller one, and more."""
    begin: int = 0
    """The episode's first step with it."""
    end: int | None = None
    """The first step without it again; none: it lasts."""

    def __post_init__(self) -> None:
        """Checks the rules."""
        most = 1.0 if self.kind == "silence" else math.inf
        end = math.inf if self.end is None else self.end
        rules = {
            "units": (re.fullmatch(UNITS, self.units), "all, or numbers such as 0-15,20"),
            "strength": (
                math.isfinite(x := self.strength) and (self.kind == "clamp" or 0.0 <= x <= most),
                f"0 to {most:g}",
            ),
            "share": (0.0 <= self.share <= 1.0, "from 0 to 1"),
            "begin": (0 <= self.begin < end, f"0 or more, and below end, {self.end}"),
        }
        for name, (holds, must) in rules.items():
            if not holds:
                raise UserError(f"{name} is {getattr(self, name)!r}; it must be {must}.")


@dataclass(frozen=True)
class RunOptions:
    """How a run is made, kept and shown; only vmapped seeds and num_shards change its bits."""

    name: str | None = None
    """Name of the run, the folder under runs/<experiment>/ (default: seed<seed>)."""
    num_seeds: int = 1
    """Train this many seeds, from --seed upwards, each in a run's folder of its own."""
    seeds_by: Literal["vmap", "map"] = "vmap"
    """vmap: all in one program, with the statistics of single runs but other bits; map: one after
    another, with the bits of single runs."""
    num_shards: int = 0
    """Cut the environments into this many parts, a multiple of the devices that share them: on any
    number of devices the bits are the same. 0: a part for each device; 1: use one device."""
    distributed: str = ""
    """One of several processes that train together: auto (SLURM, Open MPI, ...), or
    HOST:PORT,NUM_PROCESSES,PROCESS_ID, HOST being that of process 0, which alone writes the run."""
    portable: bool = False
    """On a CPU: the same bits on every x86-64 processor with AVX2, at some cost in speed."""
    resume: Annotated[Resume, RESUME] = False
    """Go on from the last whole checkpoint of the run, with its settings where none is given; auto:
    begin the run if there is none, so that one script does both."""
    allow_changes: bool = False
    """Resume although settings, versions or device differ; written down in manifest.json."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    debug: bool = False
    """Tiny sizes, where no other is given: every part of the experiment runs within a minute, most
    of which compiles. Without --runs the run goes into a temporary folder."""
    log_every: int = 0
    """Updates between two lines of metrics.jsonl; 0: chosen for about 500 lines."""
    checkpoints: int = 10
    """Checkpoints over the run, evenly spaced, the last one at the end. Each evaluation that is the
    best so far has one too."""
    keep: int = 3
    """Newest checkpoints to keep, besides the best one by evaluation."""
    tensorboard: bool = False
    """Write TensorBoard files too (needs purerl[tensorboard])."""
    wandb: Literal["off", "online", "offline"] = "off"
    """Send metrics to Weights & Biases too (needs purerl[wandb])."""
    wandb_project: str = "purerl"
    """The W&B project."""
    video: bool = False
    """When training has ended, make a video of the policy, as `python -m purerl.render` does."""
    cache: bool = True
    """Compiled programs are kept in JAX_COMPILATION_CACHE_DIR, else in purerl/jax in XDG_CACHE_HOME
    or ~/.cache; with --no-cache they are not."""

    def __post_init__(self) -> None:
        """Checks the rules."""
        least = {"num_seeds": 1, "num_shards": 0, "log_every": 0, "checkpoints": 0, "keep": 1}
        check_least(self, ValueError, **least)
        if self.debug and self.resume is True:
            raise ValueError("A debug run is made anew: leave out --resume, or --debug.")

    @property
    def vmapped_seeds(self) -> int:
        """How many seeds share one program; 1 if each is trained by itself."""
        return self.num_seeds if self.seeds_by == "vmap" else 1

    def check_vmapped(self, number: int) -> None:
        """Raises UserError where vmapped seeds would have that many shards."""
        if self.vmapped_seeds > 1 and number > 1:
            raise UserError(
                f"num_shards is {number}, and {self.num_seeds} vmapped seeds share one program "
                "on one device; use --seeds-by map, or leave out --num-shards."
            )


class TrainOptions(TypedDict, total=False):
    """`RunOptions` as keyword arguments of `train`, for type checkers; a test compares the two.

    `num_seeds` is not among them, for `train` returns another type with it; nor is `video`, which
    is the command's alone. `seed` and `engine` are settings that every experiment has, and
    `on_metrics` is of Python alone.
    """

    seed: int
    engine: Engine
    name: str | None
    seeds_by: Literal["vmap", "map"]
    num_shards: int
    distributed: str
    portable: bool
    resume: Resume
    allow_changes: bool
    runs: str | Path
    debug: bool
    log_every: int
    checkpoints: int
    keep: int
    tensorboard: bool
    wandb: Literal["off", "online", "offline"]
    wandb_project: str
    cache: bool
    on_metrics: Callable[[dict[str, Any]], Any]
