"""brax's PPO beside ours, on brax's own bodies with brax's published settings.

    python -m pip install -c constraints.txt -e '.[peers]'
    python -m experiments.brax_peer ant --json ant.json
    python -m experiments.brax_peer humanoid halfcheetah --backend mjx

Both train the same environment (`envs/brax_env.py` brings brax's into our protocol) with the same
networks, environments, samples, minibatches and epochs. The rates are those of training alone,
compiled and without evaluation: of brax its own figure ("training/sps") between two evaluations, of
ours whole updates one after another. What differs by design is what each does besides: brax takes
advantages anew in every minibatch, ours draws a fresh start for each episode.
"""

import argparse
import json
import statistics
import sys
import time
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs import brax_env
from purerl import kernels, networks, ppo, rundir
from purerl.config import Config
from purerl.experiment import Experiment
from purerl.types import PyTree


@dataclass(frozen=True)
class Published:
    """Settings of one body, under brax's names."""

    num_envs: int
    unroll_length: int
    batch_size: int  # unrolls in one minibatch
    num_minibatches: int
    num_updates_per_batch: int
    discounting: float
    learning_rate: float
    entropy_cost: float
    reward_scaling: float
    policy: tuple[int, ...] = (32,) * 4
    value: tuple[int, ...] = (256,) * 5

    @property
    def samples(self) -> int:
        """Steps of one update, all environments together."""
        return self.batch_size * self.num_minibatches * self.unroll_length


BODIES = {
    "ant": Published(4096, 5, 2048, 32, 4, 0.97, 3e-4, 1e-2, 10.0),
    "humanoid": Published(2048, 10, 1024, 32, 8, 0.97, 3e-4, 1e-3, 0.1),
    "halfcheetah": Published(2048, 20, 512, 32, 8, 0.95, 3e-4, 1e-3, 1.0),
}


class Rate(NamedTuple):
    """What was measured of one trainer."""

    name: str
    first_s: float  # from the start to the end of the first stretch, compiling included
    steps_per_second: float  # median over the later stretches


def our_experiment(body: str, backend: str, sizes: Published, num_steps: int) -> Experiment:
    """Returns brax's settings under our names."""
    config = Config(
        num_steps=num_steps,
        num_envs=sizes.num_envs,
        # brax takes several unrolls of each environment in turn, to fill its minibatches.
        rollout_length=sizes.samples // sizes.num_envs,
        num_epochs=sizes.num_updates_per_batch,
        num_minibatches=sizes.num_minibatches,
        gamma=sizes.discounting,
        clip=0.3,
        entropy_weight=sizes.entropy_cost,
        learning_rate=sizes.learning_rate,
        reward_scale=sizes.reward_scaling,
    )
    options: Any = brax_env.Options(name=body, backend=backend)  # type: ignore[arg-type]
    network = networks.MlpOptions(policy_hidden=sizes.policy, value_hidden=sizes.value, std="state")
    return Experiment(brax_env.build, options, networks.mlp, network, config)


def our_rate(chosen: Experiment, stretch: int, stretches: int) -> Rate:
    """Times stretches of updates of our training; the first one compiles."""
    begin = time.perf_counter()
    config, env, network, _ = rundir.build(chosen)
    state = jax.jit(partial(ppo.init, config, env, network))(jax.random.key(chosen.seed))
    update = jax.jit(partial(ppo.update, config, env, network), donate_argnums=0)
    ends = [time.perf_counter()]
    for _ in range(stretches):
        for _ in range(stretch):
            state, metrics = update(state)
        jax.device_get(metrics)
        ends.append(time.perf_counter())
    seconds = [b - a for a, b in zip(ends[1:-1], ends[2:], strict=True)]
    rate = stretch * config.steps_per_update / statistics.median(seconds)
    return Rate("purerl", ends[1] - begin, rate)


def lend_removed_function() -> None:
    """Gives brax 0.14.2 `jax.device_put_replicated`, which it calls and JAX 0.10 has no longer."""

    def replicate(tree: PyTree, devices: list[Any]) -> PyTree:
        return jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree)

    jax.__dict__.setdefault("device_put_replicated", replicate)


def brax_rate(body: str, backend: str, sizes: Published, stretch: int, stretches: int) -> Rate:
    """Times stretches of brax's own training; the first one compiles."""
    from brax import envs
    from brax.training.agents.ppo import networks as brax_networks
    from brax.training.agents.ppo import train

    lend_removed_function()
    times: list[float] = []
    rates: list[float] = []

    def progress(_: int, metrics: dict[str, Any]) -> None:
        times.append(time.perf_counter())
        rates.append(float(metrics.get("training/sps", 0.0)))

    names = "num_envs unroll_length batch_size num_minibatches num_updates_per_batch discounting"
    names += " learning_rate entropy_cost reward_scaling"
    begin = time.perf_counter()
    train.train(
        environment=envs.get_environment(body, backend=backend),
        num_timesteps=stretches * stretch * sizes.samples,
        episode_length=1000,
        normalize_observations=True,
        num_evals=stretches + 1,  # the first one is before training
        num_eval_envs=1,
        network_factory=partial(
            brax_networks.make_ppo_networks,
            policy_hidden_layer_sizes=sizes.policy,
            value_hidden_layer_sizes=sizes.value,
        ),
        progress_fn=progress,
        **{name: getattr(sizes, name) for name in names.split()},
    )
    return Rate("brax", times[1] - begin, statistics.median(rates[2:]))


def table(body: str, rates: list[Rate]) -> str:
    """Formats one body; ratios are to brax, the first."""
    lines = [f"| {body} | first stretch [s] | steps/s | ratio |", "|---|---|---|---|"]
    for rate in rates:
        ratio = rate.steps_per_second / rates[0].steps_per_second
        lines.append(
            f"| {rate.name} | {rate.first_s:.1f} | {rate.steps_per_second:,.0f} | {ratio:.2f} |"
        )
    return "\n".join(lines)


def compare(body: str, backend: str, sizes: Published, stretch: int, stretches: int) -> list[Rate]:
    """Times brax, then ours."""
    chosen = our_experiment(body, backend, sizes, stretches * stretch * sizes.samples)
    return [
        brax_rate(body, backend, sizes, stretch, stretches),
        our_rate(chosen, stretch, stretches),
    ]


def main(arguments: list[str]) -> int:
    """Measures the bodies that the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bodies", nargs="+", choices=tuple(BODIES))
    parser.add_argument("--backend", default="mjx", help="brax's physics")
    parser.add_argument("--stretch", type=int, default=10, help="updates in one timing")
    parser.add_argument("--stretches", type=int, default=6, help="timings; the first compiles")
    parser.add_argument("--num-envs", type=int, default=0, help="0: as published; less for a try")
    parser.add_argument("--json", default="", help="also write the figures to this file")
    options = parser.parse_args(arguments)
    kernels.fix_choice()  # before JAX starts; it holds for both trainers
    found = {}
    for body in options.bodies:
        sizes = BODIES[body]
        if options.num_envs:
            size = sizes.batch_size * options.num_envs // sizes.num_envs
            sizes = replace(sizes, num_envs=options.num_envs, batch_size=size)
        rates = compare(body, options.backend, sizes, options.stretch, options.stretches)
        print(f"{table(body, rates)}\non {jax.devices()[0].device_kind}", flush=True)
        found[body] = [rate._asdict() for rate in rates]
    if options.json:
        with open(options.json, "w") as file:
            json.dump({"device": jax.devices()[0].device_kind, "bodies": found}, file, indent=1)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
