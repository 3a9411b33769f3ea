r"""Makes the folder of a policy that comes with purerl, of a run; lists those that there are.

    python -m purerl.experiments.benchmarks.policies runs/ant_gaps/seed1 assets/policies/ant_gaps
    python -m purerl.experiments.benchmarks.policies --page docs/gallery.md

The first writes a folder from which `evaluate`, `render`, `record`, `export` and `view` play the
run's newest checkpoint, and no `--resume` goes on: the optimizer's state and the environments are
left out, as are all but a few lines and columns of metrics.jsonl. Nothing in it says where, on
which host or by whom it was trained: of the experiment's file its name is kept, and what Orbax
notes about its own folder is dropped. The second writes the table of these policies anew.
"""

import argparse
import getpass
import itertools
import json
import math
import re
import socket
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from purerl.core.errors import RunError, UserError
from purerl.experiment import loading, settings_json
from purerl.machine import array_files, files
from purerl.machine.command_errors import leave
from purerl.machine.state_arrays import flatten
from purerl.runs import checkpoint_folder, restored_run
from purerl.runs.folder import CHECKPOINTS, CODE, CONFIG, MANIFEST, METRICS, Folder, read_run
from purerl.runs.metrics_file import read_metrics
from purerl.tune.overrides import option_words

RETURN = "eval/episode_return"
KEPT = re.compile(r"update|steps|wall_s|eval/.*|train/episode_(return|length)")
LINES = 48  # of metrics.jsonl, besides the evaluations
BARS = "▁▂▃▄▅▆▇█"
COLUMNS = 16  # of the curve in the table
HEAD = (
    "| play | trained by | steps, on | return | evaluations | digest |\n|---|---|---|---|---|---|\n"
)
TABLE = re.compile(re.escape(HEAD) + r"(?:\|.*\n)*")
# A folder's name from the root on. What stands before it in a text is no part of a word.
ABSOLUTE = re.compile(rb"(?:^|[\s\"'=:(\[])(/(?:\w[\w.+-]*/)+)")
# In files of arrays the names of leaves look like one, and so do bytes by chance.
AT_HOME = re.compile(rb"/(?:home|root|tmp|usr|opt|var|mnt|srv|scratch)/\w+")


# --- the folder ---


def ship(run: Path, place: Path) -> None:
    """Writes the folder of a policy, which must be new, from a run's newest checkpoint.

    Raises:
      UserError: there is such a folder, or the run cannot be read.
      RunError: something in it tells of this machine. It stays, to be looked at.
    """
    restored = restored_run.restore(run, "latest", print)
    folder, saved = restored.folder, restored.saved
    if place.exists():
        raise UserError(f"{place} is there: delete it, or name another folder.")
    update = saved.meta["update"]
    copy = checkpoint_folder.path_of(place / CHECKPOINTS, update)
    copy.mkdir(parents=True)
    arrays = {name: array for name, array in flatten(saved.state).items() if array.size}
    array_files.write(copy / "state", arrays)
    (copy / "state" / "commit_success.txt").unlink()  # Orbax says in it where that was
    meta = saved.meta | {"files": files.hash_files(copy)}
    meta["meta_sha256"] = checkpoint_folder.hash_meta(meta)
    (copy / checkpoint_folder.META).write_text(json.dumps(meta))
    lines = thinned([x for x in read_metrics(folder.metrics) if x["update"] <= update])
    (place / METRICS).write_text("".join(json.dumps(line) + "\n" for line in lines))
    name = Path(folder.manifest["experiment_file"]).name
    files.write_file(place / CODE, folder.code)
    files.write_json(place / MANIFEST, folder.manifest | {"experiment_file": name})
    files.write_json(place / CONFIG, folder.config)
    if told := list(tells_of_machine(place)):
        raise RunError(f"{place} tells of this machine: {'; '.join(told)}.")


def thinned(lines: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns about LINES lines of metrics, and the evaluations, with the columns in KEPT."""
    every = math.ceil(len(lines) / LINES)
    wanted = [x for i, x in enumerate(lines) if (len(lines) - 1 - i) % every == 0 or RETURN in x]
    return [{k: v for k, v in line.items() if KEPT.fullmatch(k)} for line in wanted]


def tells_of_machine(folder: Path) -> Iterator[str]:
    """Yields the files of a folder that name a place, this host or this user, and what they say."""
    people = {socket.gethostname(), getpass.getuser()} - {"root"}  # a word of many bodies, too
    words = re.compile(rb"\b(" + b"|".join(re.escape(x.encode()) for x in people if x) + rb")\b")
    for file in sorted(file for file in folder.rglob("*") if file.is_file()):
        content = file.read_bytes()
        try:
            content.decode()
            found = ABSOLUTE.findall(content) + [x for x in words.findall(content) if x]
        except UnicodeDecodeError:
            found = AT_HOME.findall(content)
        for what in found[:1]:
            yield f"{file.relative_to(folder)}: {what.decode(errors='replace')}"


# --- the table ---


def table(policies: Path = loading.POLICIES) -> str:
    """Returns the table of the policies in a folder, in Markdown."""
    return HEAD + "".join(map(row, sorted(policies.glob(f"*/{CONFIG}"))))


def row(config: Path) -> str:
    """Returns a policy's line: how it is played and trained, what it reaches, its digest."""
    folder = read_run(config.parent)
    (update,) = folder.updates
    meta = checkpoint_folder.load_meta(checkpoint_folder.path_of(folder.checkpoints, update))
    device, lines = folder.manifest["device"], read_metrics(folder.metrics)
    where = device["kind"] + (f", {n} threads" if (n := device.get("threads")) else "")
    evaluated = [x for x in lines if RETURN in x]
    reached = f"{evaluated[-1][RETURN]:,.0f} ± {evaluated[-1][f'{RETURN}_std']:,.0f}"
    cells = (
        f"`python -m purerl.view {folder.path.name}`",
        f"`{training_command(folder)}`",
        f"{meta['steps'] / 1e6:.1f} M, {where}, {meta['wall_s'] / 60:.1f} min",
        reached,
        curve([x[RETURN] for x in evaluated]),
        f"`{meta['digest']}`",
    )
    return f"| {' | '.join(cells)} |\n"


def training_command(folder: Folder) -> str:
    """Returns the command that trains a run again: its settings beside the experiment's own."""
    name = folder.config["experiment"]
    written = loading.find(name)
    settings = settings_json.to_json(written)
    settings = restored_run.fill(folder.config["settings"], settings, lambda line: None)
    chosen = settings_json.from_json(written, settings)
    values = settings_json.settings_of(chosen).items()
    words = [w for n, v in values for w in option_words(n, getattr(written, n), v)]
    return " ".join(["python -m purerl.run", name, *words])


def curve(values: Sequence[float], columns: int = COLUMNS) -> str:
    """Returns a curve as characters, each the mean of its share of the values.

    >>> curve([0.0, 0.0, 1.0, 2.0], 2)
    '▁█'
    """
    columns = min(columns, len(values))
    ends = [round(i * len(values) / columns) for i in range(columns + 1)]
    means = [sum(values[a:b]) / (b - a) for a, b in itertools.pairwise(ends)]
    low, size = min(means), (max(means) - min(means)) or 1.0
    return "".join(BARS[min(int((x - low) / size * len(BARS)), len(BARS) - 1)] for x in means)


def main() -> int:
    """Makes a folder, or writes the table into a page; returns the exit code."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=plain)
    parser.add_argument("run", type=Path, nargs="?", help="folder of a run that has ended")
    parser.add_argument("place", type=Path, nargs="?", help="the new folder")
    parser.add_argument("--page", type=Path, help="with the table, which is written anew")
    asked = parser.parse_args()
    if asked.place is not None:
        ship(asked.run, asked.place)
        size = sum(file.stat().st_size for file in asked.place.rglob("*") if file.is_file())
        print(f"{asked.place} ({size:,} bytes)")
    if asked.page is not None:
        asked.page.write_text(TABLE.sub(lambda _: table(), asked.page.read_text()))
    return 0


if __name__ == "__main__":
    leave(main)
