"""Evaluates a run: `python -m purerl.evaluate RUN [--episodes 100] [--checkpoint best] [--json F]`.

RUN is a run's folder; nothing else is needed, and nothing in it is changed.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from purerl.core.errors import UserError
from purerl.runs.command_errors import leave, tell


@dataclass(frozen=True)
class Options:
    """Evaluates a run's policy on whole episodes in fresh environments."""

    run: Annotated[Path, tyro.conf.Positional]
    """The run's folder, such as runs/ant/seed1."""
    episodes: int = 100
    """Whole episodes, each in an environment of its own."""
    seed: int = 0
    """Seed of the episodes; never meets a seed of training."""
    checkpoint: str = "latest"
    """latest, best (highest evaluation return), or an update's number."""
    stochastic: bool = False
    """Sample actions instead of taking the distribution's centre."""
    engine: Literal["", "auto", "c", "jax", "warp"] = ""
    """Physics engine, where it should not be the run's own."""
    json: Path | None = None
    """Also write the result to this file as JSON, every episode's figures included."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    from purerl.runs.command_line import parse

    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        options = parse(Options, arguments, "python -m purerl.evaluate")
        print("\n".join(describe(evaluate_run(options))))
    except UserError as error:
        return tell(error)
    return 0


def evaluate_run(options: Options) -> dict[str, Any]:
    """Evaluates and returns the result: for each metric mean, std, min, max and every value."""
    import jax
    import numpy as np

    from purerl.core.keys import Purpose, derive
    from purerl.devices.compilation import set_up_jax
    from purerl.ppo.evaluation import evaluate
    from purerl.runs.files import write_json
    from purerl.runs.run_folder import restore

    if options.episodes < 1:
        raise UserError(f"episodes is {options.episodes}; it must be at least 1.")
    if options.json is not None and not options.json.absolute().parent.is_dir():
        raise UserError(f"{options.json} cannot be written: there is no such folder.")
    set_up_jax(cache=True)
    run = restore(options.run, options.checkpoint, lambda line: print(line), options.engine)
    config, env, network, engine = run.setup

    def judge(state: Any, key: Any) -> dict[str, Any]:
        return evaluate(
            config, env, network, state, key, options.episodes, not options.stochastic
        )  # fmt: skip

    key = derive(jax.random.key(options.seed), Purpose.EVALUATION)
    values = jax.device_get(jax.jit(judge)(run.saved.state, key))
    result = {
        "run": str(options.run),
        "update": run.saved.meta["update"],
        "steps": run.saved.meta["steps"],
        "digest": run.saved.meta["digest"],
        "engine": engine,
        "seed": options.seed,
        "policy": "stochastic" if options.stochastic else "deterministic",
        "episodes": options.episodes,
        "metrics": {name: statistics(np.asarray(x, float)) for name, x in sorted(values.items())},
    }
    if options.json is not None:
        write_json(options.json, result)
    return result


def statistics(values: Any) -> dict[str, Any]:
    """Summarises one metric of all episodes, [N]; std is over the episodes (divided by N)."""
    return {
        "mean": float(values.mean()),
        "std": float(values.std()),
        "min": float(values.min()),
        "max": float(values.max()),
        "values": values.tolist(),
    }


def describe(result: dict[str, Any]) -> list[str]:
    """Returns the result as lines for a person, the return first."""
    metrics = dict(result["metrics"])
    ordered = {"episode_return": metrics.pop("episode_return")} | metrics
    width = max(map(len, ordered))
    return [
        f"{result['run']}, update {result['update']:,} ({result['steps']:,} steps), "
        f"{result['policy']} policy, engine {result['engine']}, N = {result['episodes']} episodes",
        f"{'':{width}}  {'mean':>12} {'std':>12} {'min':>12} {'max':>12}",
        *(
            f"{name:{width}}  {s['mean']:12.4f} {s['std']:12.4f} {s['min']:12.4f} {s['max']:12.4f}"
            for name, s in ordered.items()
        ),
    ]


if __name__ == "__main__":
    leave(main)
