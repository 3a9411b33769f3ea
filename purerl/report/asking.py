"""A policy under other conditions: episodes of runs under each, as rows and as a picture."""

import dataclasses
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from purerl.core.errors import UserError, unknown_name
from purerl.core.keys import Purpose, derive
from purerl.core.records import Array, TrainState
from purerl.experiment.command_line import WORDS, from_command_line
from purerl.experiment.definition import Experiment
from purerl.experiment.loading import Source
from purerl.experiment.objects import Setup, build, check_observation
from purerl.experiment.options import Lesion
from purerl.experiment.settings_json import to_json
from purerl.machine.output import printable
from purerl.machine.state_arrays import leaf_paths
from purerl.ppo import evaluation
from purerl.report import lesions
from purerl.report.bootstrap import episode_interval, mean_interval
from purerl.report.comparison import picture
from purerl.report.run_reader import flatten
from purerl.runs.manifest import differences

Case = tuple[Any, Experiment, Lesion]  # a condition: the value of what varies, and all settings
# What a run's episodes were like under one: "run", "seed", "value", "lesion", "strength", "units";
# figure -> [N], under the option's own name what each had of what varies, if the environment tells.
Answer = tuple[dict[str, Any], dict[str, np.ndarray]]
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
CLIP = "task/clip"  # among figures, until `named` has put the clip's name there: no metric's name
COLUMNS = ("run", "lesion", "value", "n", "mean", "interval")


def cases(source: Source, experiment: Experiment, options: Any, prog: str) -> list[Case]:
    """Returns the conditions of a command line; before each with a lesion, the same without it.

    Args:
      source: of the experiment.
      experiment: with the settings that were given.
      options: the command's: `vary` and `lesion`.
      prog: the command, for errors.

    Raises:
      UserError: there is no such option, or a value is wrong.
    """
    name, values = options.varied, options.vary[1:] if options.vary else ("",)
    held = flatten(to_json({"env": experiment.env, "lesion": options.lesion})) | {"": None}
    if name not in held:
        raise UserError(unknown_name("option", name, held, " to vary"))
    if not values:
        raise UserError(f"vary is {name}; give values too, as in --vary {name} 0.1 0.2.")
    found: list[Case] = []
    for at, value in {float(x) if NUMBER.fullmatch(x) else x: x for x in values}.items():
        # One number is both ends of a range.
        times = len(held[name]) if isinstance(held[name], list) and name[:4] == "env." else 1
        words = [f"--{name.replace('_', '-')}", *[value] * times] if name else []
        over = lambda _, over: over(experiment, **vars(options))  # noqa: E731
        read = from_command_line(source, words, prog, WORDS, type(options), ("env",), over)
        chosen, lesion = read[0], read[1].lesion
        if lesion.layer and not name.startswith("lesion."):
            found.append((at, chosen, dataclasses.replace(lesion, share=0.0)))
        found.append((at, chosen, lesion))
    return found


def ask(runs: dict[str, Any], asked: Sequence[Case], options: Any) -> Iterator[Answer]:
    """Plays N whole episodes of each run under each condition, which begin from the same keys.

    Args:
      runs: name -> what `load` returned; all of one configuration.
      asked: the conditions.
      options: the command's: `episodes`, `seed`, `outcome`, and `vary`.

    Raises:
      UserError: the policy cannot act in such an environment, there is no such layer, or the
        outcome is no figure of an episode.
    """
    first, seed, kept = next(iter(runs.values())), options.seed, dict[str, Any]()
    for value, experiment, lesion in asked:
        name = repr((experiment.env, lesion.layer, lesion.kind))
        if name not in kept:
            setup = setup_of(experiment, first)
            layers = lesions.units_of(setup, first.state) if lesion.layer else {}
            acting = lesions.lesioned(setup, first.state, lesion, seed, layers)
            kept = {name: (setup, layers, program(*acting[:2], options))}
        setup, layers, judge = kept[name]
        for label, run in runs.items():
            _, state, units = lesions.lesioned(setup, run.state, lesion, seed, layers)
            about = {"run": label, "seed": run.experiment.seed, "value": value, "units": units}
            about["lesion"] = " ".join([lesion.kind, *lesion.layer]) if units else "intact"
            about["strength"] = lesion.strength if units else None
            key = derive(jax.random.key(seed), Purpose.EVALUATION)
            yield about, named(setup.env, jax.device_get(judge(state, key)))


def setup_of(experiment: Experiment, run: Any) -> Setup:
    """Returns the objects of a run's experiment with other settings; `run`: what `load` returned.

    Raises:
      UserError: the observations are others than the policy knows.
    """
    if experiment == run.experiment:
        return run.restored.setup
    setup = build(experiment)
    learned = jax.eval_shape(run.env.reset, jax.random.key(0)).observation
    check_observation(setup.env, learned)
    return setup


def acting(run: Any, experiment: Experiment, options: Any) -> tuple[Setup, TrainState]:
    """Returns a run's policy as it acts in an experiment, with the `lesion` of a command's options.

    Arguments and errors as `setup_of` and `lesions.lesioned` have them.
    """
    setup = setup_of(experiment, run)
    return lesions.lesioned(setup, run.state, options.lesion, options.seed)[:2]


def changes(before: Experiment, now: Experiment, options: Any) -> list[str]:
    """Returns what of an environment and a command's options is not as usual: `a: old -> new`."""
    usual = {"env": before.env, **vars(type(options)())}
    found = differences(to_json(usual), to_json({"env": now.env, **vars(options)}))
    return [line for line in found if line.partition(":")[0] not in ("checkpoint", "trust", "out")]


def program(setup: Setup, state: TrainState, options: Any) -> Callable[..., Any]:
    """Returns a program of (state, key) -> the figures of an `Answer`.

    What an episode has of the option that varies is a metric, or a number of `task`, of its name.
    Of imitation there is CLIP, the number of the clip that it follows.
    """
    config, env, network, _ = setup
    sizes = {"num_episodes": options.episodes, "episode_length": config.episode_length}

    def judge(state: TrainState, key: Array) -> dict[str, Array]:
        reset_key, _ = jax.random.split(jax.random.clone(key))  # as `evaluate_policy` does
        begun = evaluation.start(env, state, reset_key, **sizes).env_state
        option = options.varied.partition("env.")[2].split(".")[-1]
        told = begun.task, begun.metrics
        leaves = dict(zip(leaf_paths(told), jax.tree.leaves(told), strict=True))
        had = {path.split("/")[-1]: x for path, x in leaves.items() if x.ndim == 1}
        own = {options.varied: had[option]} if option in had else {}
        own |= {CLIP: leaves["0/clip"]} if "0/clip" in leaves and hasattr(env, "names") else {}
        return own | evaluation.evaluate_policy(env, network, state, key, **sizes)

    names = jax.eval_shape(judge, state, jax.random.key(0)).keys() - {CLIP}
    if options.outcome not in names:
        raise UserError(unknown_name("outcome", options.outcome, sorted(names)))
    return jax.jit(judge)


def named(env: Any, figures: dict[str, Any]) -> dict[str, Any]:
    """Returns the figures with each clip's name, `clip`, in the place of its number."""
    rest = {name: x for name, x in figures.items() if name != CLIP}
    return rest | ({"clip": np.array(env.names)[figures[CLIP]]} if CLIP in figures else {})


def summarize(answers: Sequence[Answer], outcome: str) -> list[dict[str, Any]]:
    """Returns a row for each run and condition, and one of several runs' mean.

    Each has what is in `COLUMNS`; its interval is one over the run's episodes, or over the runs.
    """
    rows, means = [], dict[tuple, dict[str, float]]()  # a run may have one condition twice
    for about, found in answers:
        x = found[outcome].astype(float)
        rows.append(about | {"n": len(x), "mean": float(x.mean()), "interval": episode_interval(x)})
        means.setdefault((about["lesion"], about["value"]), {})[about["run"]] = float(x.mean())
    for (lesion, value), of_runs in means.items():
        each = list(of_runs.values())
        about = {"run": f"{len(each)} runs", "lesion": lesion, "value": value, "n": len(each)}
        mean = {"mean": float(np.mean(each)), "interval": mean_interval(np.array(each))}
        rows += [about | mean] * (len(each) > 1)
    return rows


def draw(path: Path, rows: Sequence[dict[str, Any]], varied: str, outcome: str) -> None:
    """Writes a picture of the rows of `summarize`: a colour for each lesion, single runs faint."""
    curves: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        lesion = "" if varied.startswith("lesion.") else row["lesion"]
        curves.setdefault((lesion, row["run"]), []).append(row)
    colors = list(dict.fromkeys(lesion for lesion, _ in curves))
    with picture(path, figsize=(8, 5)) as (_, axes):
        for (lesion, run), own in curves.items():
            x, y = [row["value"] for row in own], np.array([row["mean"] for row in own])
            ends = np.array([row["interval"] or (row["mean"],) * 2 for row in own]).T
            alpha = 1.0 if run == rows[-1]["run"] else 0.3  # of the mean, if there are several
            style = {"color": f"C{colors.index(lesion)}", "alpha": alpha, "marker": "o"}
            label = printable(f"{run} {lesion}")
            axes.errorbar(x, y, abs(ends - y), label=label, capsize=3, **style)
        told = {row["lesion"] for row in rows if varied.startswith("lesion.")} - {"intact"}
        title = "\n".join([*map(printable, told), "Mean, and 95% interval from 5 values on"])
        axes.set(xlabel=varied, ylabel=outcome, title=title)
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")


def notes(answers: Sequence[Answer], varied: str) -> list[str]:
    """Returns what a reader must know: of what changed nothing, was not as asked, or went wrong."""
    lines, own, different = [], (varied, varied.split(".")[-1]), set()
    for about, found in answers:
        figures = b"".join(x.tobytes() for name, x in sorted(found.items()) if name not in own)
        different.add((about["run"], figures))
        had = found.get(varied)
        if had is not None and not np.allclose(had, about["value"], 1e-3):
            said = f"{about['value']} was asked for, and the episodes had"
            lines.append(f"{varied}: {said} {had.min():.4g} to {had.max():.4g}.")
        if lost := int(found["lost"].sum()):
            lines.append(f"{lost} episodes were lost (NaN, or an absurd number): {about}.")
    if same := len(answers) - len(different):
        said = "have to the bit the episodes of another one: there, nothing was changed."
        lines.append(f"{same} of {len(answers)} conditions {said}")
    return lines
