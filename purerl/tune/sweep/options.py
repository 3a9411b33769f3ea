"""The command line of a sweep: its own options, a TOML file instead, and what goes to the runs."""

import dataclasses
import re
import shlex
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from purerl.core.errors import UserError, check_least, nearest, one_line, unknown_name
from purerl.experiment import command_line, loading
from purerl.experiment.options import RunOptions
from purerl.machine.files import check_name, read_bytes
from purerl.report.run_reader import flatten
from purerl.tune.sweep import points

PROG = "python -m purerl.sweep"
# Options of a run that a sweep gives itself, and what to say instead.
NOT_HERE = {
    "--num-seeds": "give --seeds",
    "--runs": "the runs are in the sweep's folder: give --sweeps or --name",
    "--resume": "the same command goes on by itself: leave it out",
    "--distributed": "a sweep starts each run as one process",
    "--name": "it names the sweep: in a file it stands above [settings]",
}


@dataclass(frozen=True)
class SweepOptions:
    """Trains an experiment with many settings: EXPERIMENT [options] [settings as `run` takes].

    Instead of EXPERIMENT a file SWEEP.toml may stand, which has all of it. The settings are listed
    by `python -m purerl.run EXPERIMENT --help`. The same command goes on with a sweep that was
    stopped. Exit codes: 0 done, 1 a run failed, 2 a mistake in the command, 3 stopped on request.
    """

    grid: Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction] = ()
    """SETTING=1,2,3: every combination of the values. May come several times."""
    over: Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction] = ()
    """SETTING=1..8, SETTING=log:1e-5:1e-2 or SETTING=1,2,3: drawn by --random or --optuna."""
    random: int = 0
    """Draw this many points; with a larger number later, the first ones stay."""
    optuna: int = 0
    """Let Optuna choose this many points by the scores so far (needs purerl[sweep])."""
    seeds: int = 3
    """Seeds of each point, from --seed upwards, in one process."""
    metric: str = "eval/episode_return"
    """The score: its last value; more is better."""
    jobs: int = 0
    """Processes at once; 0: one for each GPU, else for every two cores (cores / NPROC)."""
    name: str = ""
    """Name of the sweep, the folder under --sweeps (default: the experiment's name)."""
    sweeps: Path = Path("sweeps")
    """Folder of all sweeps."""
    slurm: str = ""
    """Submit to SLURM and return: submitit's parameters, as timeout_min=240,gpus_per_node=1;
    cluster=local tries it here (needs purerl[sweep])."""
    dry_run: bool = False
    """Check everything, print the commands, and start none."""


OWN = {f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(SweepOptions)}


def read(arguments: Sequence[str]) -> tuple[SweepOptions, points.Base, list[str]]:
    """Reads a whole command line.

    Returns:
      The sweep's options, what its points share, and the names of the options among that.

    Raises:
      UserError: whatever is wrong with it.
    """
    words, settings = list(arguments), dict[str, Any]()
    if words[0].endswith(".toml"):
        first, settings = _read_file(Path(words[0]))
        words = first + words[1:]
    if words[0].startswith("-"):
        raise UserError(f"The first word must be the experiment or a .toml file: {PROG} EXPERIMENT")
    named, *words = words
    # What is none of the sweep's own options goes to the runs.
    options, rest = command_line.parse(SweepOptions, words, PROG, return_unknown_args=True)
    if options.name:
        check_name("name", options.name)
    source = loading.find_source(named)
    folder = options.sweeps / (options.name or source.name)
    base = points.Base(named, source, source.experiment, (), options.seeds, folder, RunOptions())
    for name, value in settings.items():
        rest += points.option_words(base, name, _text(name, value))
    chosen, of_run = _read_settings(source, named, rest)
    given = [word.partition("=")[0] for word in rest]
    given = [word.replace("_", "-") for word in given if word.startswith("--")]
    for word, instead in NOT_HERE.items():
        if word in given:
            raise UserError(f"{word} is no option of a sweep's runs; {instead}.")
    check(options)
    of_run = dataclasses.replace(of_run, num_seeds=options.seeds)
    of_run.check_vmapped(of_run.num_shards)  # as each run would, after JAX has begun
    return options, base._replace(chosen=chosen, words=tuple(rest), options=of_run), given


def check(options: SweepOptions) -> None:
    """Raises UserError unless the options go together."""
    ways = [name for name in ("grid", "random", "optuna") if getattr(options, name)]
    if len(ways) > 1:
        raise UserError(f"--{ways[0]} and --{ways[1]} are two sweeps; give one of them.")
    drawn = ways in (["random"], ["optuna"])
    if options.over and not drawn:
        raise UserError("--over says what is drawn; say how many points: --random 20.")
    if drawn and not options.over:
        raise UserError(f"--{ways[0]} draws nothing; say what: --over SETTING=log:1e-5:1e-2.")
    check_least(options, UserError, seeds=1, jobs=0, random=0, optuna=0)
    if options.slurm and options.optuna:
        raise UserError(
            "--optuna chooses a point when others have ended, and --slurm submits all at once; "
            "leave one of them out."
        )


def _read_settings(source: Any, named: str, rest: list[str]) -> Any:
    """Returns the experiment with what all points share, and the options of each run.

    A wrong option may be near one of ours.
    """
    try:
        prog = f"python -m purerl.run {shlex.quote(named)}"
        return command_line.from_command_line(source, rest, prog)
    except UserError as error:
        wrong = re.match(r"There is no option (\S+)\. All", str(error))
        near = nearest(wrong[1], sorted(OWN)) if wrong else ""
        if not near:
            raise
        text = f"There is no option {wrong and wrong[1]}. Did you mean {near}?"
        raise UserError(f"{text} All options: {PROG} --help") from error


# --- a file ---


def _read_file(path: Path) -> tuple[list[str], dict[str, Any]]:
    """Returns a TOML file as words of the command line, and the settings that all points share."""
    try:
        found = tomllib.loads(read_bytes(path).decode())
    except ValueError as error:
        raise UserError(f"{path} is no TOML: {one_line(error)}.") from error
    own = {word.removeprefix("--") for word in OWN - {"--dry-run"}}
    valid = ["experiment", "settings", *sorted(own)]
    for name in found:
        if name.replace("_", "-") not in valid:
            raise UserError(f"{path}: {unknown_name('key', name, valid)}")
    if not isinstance(found.get("experiment"), str):
        raise UserError(f'{path} names no experiment; write experiment = "cartpole_swingup".')
    words = [found.pop("experiment")]
    settings = _table(path, "settings", found.pop("settings", {}))
    for name in ("grid", "over"):
        for setting, values in _table(path, name, found.pop(name, {})).items():
            words += [f"--{name}", f"{setting}={_texts(path, setting, values)}"]
    for name, value in found.items():
        words += [f"--{name.replace('_', '-')}", _text(name, value)]
    return words, settings


def _table(path: Path, name: str, value: Any) -> dict[str, Any]:
    """Returns a table with dotted names, `{"ppo": {"clip": 1}}` as `{"ppo.clip": 1}`."""
    if not isinstance(value, Mapping):
        raise UserError(f"{path}: {name} is {value!r}; it must be a table, [{name}].")
    return {key.replace("_", "-"): one for key, one in flatten(value).items()}


def _texts(path: Path, setting: str, values: Any) -> str:
    """Returns a swept setting's values as on a command line, where commas part them."""
    if not isinstance(values, list):
        return _text(setting, values)
    texts = [_text(setting, value) for value in values]
    if cut := [text for text in texts if "," in text]:
        raise UserError(
            f"{path}: {setting} has the value {cut[0]!r}, and a comma parts values; write each "
            "part as a text of its own, or choose a value without a comma."
        )
    return ",".join(texts)


def _text(name: str, value: Any) -> str:
    """Returns a value of the file as on a command line: true, 0.001, or `64 64` of a list."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return " ".join(_text(name, one) for one in value)
    if not isinstance(value, str | int | float):
        raise UserError(f"{name} is {value!r}; it must be a number, a text or a list of them.")
    return str(value)
