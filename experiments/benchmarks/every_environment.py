"""Every environment on every engine: does it keep the contract, and how fast is it?

    python -m purerl.experiments.benchmarks.every_environment
    python -m purerl.experiments.benchmarks.every_environment --engines c --only walker-walk

A row has control steps/s of the bare engine under random controls, of the rollout (policy, reward,
observations and resets included), and the rollout's share; both timed in turns in one process.
"""

import argparse
import dataclasses
from functools import partial

import jax

from purerl.checks.check_env import check_env
from purerl.core.errors import UserError, one_line
from purerl.envs.suite.tasks import TASKS, Options as SuiteOptions
from purerl.experiment import objects
from purerl.experiment.definition import Experiment
from purerl.experiment.loading import find
from purerl.experiment.options import Engine
from purerl.experiments.benchmarks.benchmark import bare_physics, compile_part, measure
from purerl.experiments.benchmarks.output import count
from purerl.machine.command_errors import leave
from purerl.ppo import algorithm
from purerl.ppo.rollout import rollout

OURS = ("cartpole_swingup", "ant_run", "ant_gaps", "rodent_run", "rodent_gaps")
ROW = "| {:24} | {:6} | {:8} | {:>13} | {:>9} | {:>5} |"


def all_experiments() -> dict[str, Experiment]:
    """Returns name -> experiment: ours, and each task of the suite."""
    suite = find("suite")
    of_suite = {name: dataclasses.replace(suite, env=SuiteOptions(task=name)) for name in TASKS}
    return {name: find(name) for name in OURS} | of_suite


def sized(experiment: Experiment, engine: Engine, num_envs: int, length: int) -> Experiment:
    """Returns the experiment on an engine, with B environments, T steps a rollout; 0: its own."""
    num_envs, length = num_envs or experiment.ppo.num_envs, length or experiment.ppo.rollout_length
    steps = num_envs * length
    config = dataclasses.replace(
        experiment.ppo, num_envs=num_envs, rollout_length=length, num_minibatches=1, num_steps=steps
    )
    return dataclasses.replace(experiment, engine=engine, ppo=config)


def row(name: str, experiment: Experiment, engine: Engine, rounds: int) -> str:
    """Checks and times one environment on one engine."""
    config, env, network, _ = objects.build(experiment)
    check_env(env, num_envs=2, num_steps=2)
    key = jax.random.key(experiment.seed)
    state = jax.jit(partial(algorithm.init, config, env, network))(key)
    steps = config.steps_per_update
    parts = [
        compile_part("physics", partial(bare_physics, env, config), (state, key), steps),
        compile_part("rollout", partial(rollout, config, env, network), (state,), steps),
    ]
    bare, whole = (t.steps_per_second for t in measure(parts, rounds, 0.2))
    return ROW.format(name, engine, "kept", f"{bare:,.0f}", f"{whole:,.0f}", f"{whole / bare:.2f}")


def main() -> int:
    """Prints the table; exit code 1 if an environment breaks the contract."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        "purerl.experiments.benchmarks.every_environment",
        description=__doc__,
        formatter_class=plain,
    )
    experiments = all_experiments()
    parser.add_argument("--engines", nargs="+", default=["c", "jax"])
    parser.add_argument("--only", nargs="+", default=list(experiments), choices=list(experiments))
    parser.add_argument("--num-envs", type=int, default=0, help="0: its own")
    parser.add_argument("--length", type=int, default=0, help="steps of a rollout; 0: its own")
    parser.add_argument("--rounds", type=count, default=3)
    options = parser.parse_args()
    print(ROW.format("environment", "engine", "contract", "physics alone", "rollout", "share"))
    print("|---|---|---|---|---|---|", flush=True)
    broken = 0
    for name in options.only:
        for engine in options.engines:
            one = sized(experiments[name], engine, options.num_envs, options.length)
            try:
                line = row(name, one, engine, options.rounds)
            except (ValueError, UserError) as error:
                line, broken = ROW.format(name, engine, "BROKEN", *"   ") + one_line(error), 1
            print(line, flush=True)
    return broken


if __name__ == "__main__":
    leave(main)
