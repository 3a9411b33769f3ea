"""brax's PPO beside ours, on brax's own bodies with brax's published settings: steps per second.

    python -m pip install -c constraints.txt -e '.[peers]'
    python -m purerl.experiments.peers.brax_peer ant humanoid --json rates.json
    python -m purerl.experiments.peers.brax_peer ant --trainers brax # XLA chooses kernels

Same observation, reward, end and start (brax's code, `experiments/peers/brax_env.py`), widths of
networks, environments, samples, minibatches and epochs; no evaluation and no checkpoint. Three
lines of a table:

    brax                      its own figure, "training/sps", between calls of its progress function
    purerl on brax's physics  MJX as brax calls it, the whole `mjx.Data` carried from step to step
    purerl                    the same MuJoCo model on purerl's physics, engine `jax`

A line's physics alone is that physics under random actions, from the same starts, without
observation, reward or network; brax's is that of the second line. What differs by design is what
each trainer does besides: ours draws a fresh start for each episode, takes MJX's matrix products in
whole float32, and computes advantages once an update, where brax cuts what it has collected into
unrolls and does so again in every minibatch.

Returns: `experiments/peers/brax_training.py`, ours with settings of our own.
"""

import argparse
import json
import statistics
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from purerl import exact, networks
from purerl.core.records import Array, PyTree
from purerl.devices import compilation
from purerl.devices.programs import abstract_state, compile_programs
from purerl.devices.shards import Shards
from purerl.experiment import objects
from purerl.experiment.definition import Experiment
from purerl.experiments.benchmarks.benchmark import Part, measure
from purerl.experiments.benchmarks.output import output_file
from purerl.experiments.peers import brax_env
from purerl.experiments.peers.sb3 import Ours
from purerl.machine.command_errors import leave
from purerl.ppo.config import Config, Evaluation


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
ACTIONS = {"ant": 8, "humanoid": 17, "halfcheetah": 6}
EPISODE_LENGTH = 1000
NO_CLIPPING = 1e9  # of gradients: brax has none


class Rate(NamedTuple):
    """What was measured of one trainer; control steps per second."""

    name: str
    physics: str
    training: float
    physics_alone: float | None  # None: not measured in this process


def resize(sizes: Published, num_envs: int) -> Published:
    """Returns the settings for fewer environments, with as much fewer unrolls; 0: as they are."""
    if not num_envs:
        return sizes
    return replace(
        sizes, num_envs=num_envs, batch_size=sizes.batch_size * num_envs // sizes.num_envs
    )


def our_experiment(body: str, physics: str, sizes: Published, num_steps: int) -> Experiment:
    """Returns brax's settings under our names."""
    config = Config.plain(
        num_steps=num_steps,
        num_envs=sizes.num_envs,
        # brax takes several unrolls of each environment in turn, to fill its minibatches.
        rollout_length=sizes.samples // sizes.num_envs,
        num_epochs=sizes.num_updates_per_batch,
        num_minibatches=sizes.num_minibatches,
        episode_length=EPISODE_LENGTH,
        gamma=sizes.discounting,
        clip=0.3,
        entropy_weight=sizes.entropy_cost * ACTIONS[body],  # brax has a sum over the actions
        max_gradient_norm=NO_CLIPPING,
        learning_rate=sizes.learning_rate,
        reward_scale=sizes.reward_scaling,
    )
    options: Any = brax_env.Options(name=body, backend=physics)  # type: ignore[arg-type]
    network = networks.MlpOptions(
        policy_hidden=sizes.policy,
        value_hidden=sizes.value,
        std="state",
        initial_std=0.6,
        min_std=1e-3,
    )
    return Experiment(brax_env.build, options, networks.mlp, network, config, engine="jax")


def physics_alone(env: Any, num_steps: int, start: PyTree, key: Array) -> Array:
    """Steps the physics of B brax environments, [B] `start`; returns positions [B, nq].

    Only positions are returned, so that what the next step does not need is not computed.
    """
    size = len(start.q), env.action_size

    def step(physics: PyTree, t: Array) -> tuple[PyTree, None]:
        action = jax.random.uniform(jax.random.fold_in(key, t), size, minval=-1.0, maxval=1.0)
        return brax_env.plain(jax.vmap(env.step_physics)(physics, action)), None

    return jax.lax.scan(step, start, jnp.arange(num_steps))[0].q


def our_parts(chosen: Experiment) -> list[Part]:
    """Compiles the physics alone and our training, side by side, and makes the first update."""
    config, env, network, _ = objects.build(chosen)
    key = jax.random.key(chosen.seed)
    abstract = abstract_state(config, env, network).env_state.physics
    bare: Callable = partial(physics_alone, env, config.rollout_length)
    compiling = compilation.start("physics alone", jax.jit(bare).trace(abstract, key))
    never = Evaluation(number=0)
    programs = compile_programs(config, env, network, never, True, Shards())
    (alone, _), state = compiling.result(), programs.init(key)
    # A copy: an update takes its state over.
    start = jax.tree.map(jnp.copy, state.env_state.physics)
    trainer = Ours(programs.update, state)
    trainer()
    return [
        Part("physics alone", lambda: alone(start, key), config.steps_per_update, 0.0, 0),
        Part("training", trainer, config.steps_per_update, 0.0, 0),
    ]


def our_rates(body: str, backend: str, sizes: Published, rounds: int) -> list[Rate]:
    """Measures our training and the physics alone, on brax's physics and on ours."""
    lines = {backend: "purerl on brax's physics", "purerl": "purerl"}
    chosen = [our_experiment(body, physics, sizes, sizes.samples) for physics in lines]
    with ThreadPoolExecutor() as pool:
        found = list(pool.map(our_parts, chosen))
    names = [f"{part.name}, {physics}" for physics, pair in zip(lines, found, strict=True)
             for part in pair]  # fmt: skip
    parts = [part._replace(name=name) for name, part in zip(names, sum(found, []), strict=True)]
    rates = [timing.steps_per_second for timing in measure(parts, rounds, least_s=0.0)]
    pairs = zip(lines.items(), rates[0::2], rates[1::2], strict=True)
    return [Rate(name, physics, whole, bare) for (physics, name), bare, whole in pairs]


def lend_removed_function() -> None:
    """Gives brax 0.14.2 `jax.device_put_replicated`, which it calls and JAX 0.10 has no longer."""

    def replicate(tree: PyTree, devices: list[Any]) -> PyTree:
        return jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree)

    jax.__dict__.setdefault("device_put_replicated", replicate)


def train_brax(
    body: str,
    backend: str,
    sizes: Published,
    updates: int,
    stretches: int,
    progress: Callable[[int, dict[str, Any]], None],
    num_episodes: int = 0,
    seed: int = 0,
) -> None:
    """Runs brax's training.

    Args:
      body: brax's name of the environment.
      backend: brax's name of its physics.
      sizes: the settings.
      updates: of one stretch, which is one call of a compiled program.
      stretches: of the whole training.
      progress: told (steps, metrics) after each stretch; with evaluations also before the first.
      num_episodes: of each evaluation, of the deterministic policy; 0: no evaluations.
      seed: brax's.
    """
    from brax import envs
    from brax.training.agents.ppo import networks as brax_networks, train

    lend_removed_function()
    names = "num_envs unroll_length batch_size num_minibatches num_updates_per_batch discounting"
    names += " learning_rate entropy_cost reward_scaling"
    train.train(
        environment=envs.get_environment(body, backend=backend),
        num_timesteps=stretches * updates * sizes.samples,
        episode_length=EPISODE_LENGTH,
        normalize_observations=True,
        num_evals=stretches + 1,
        num_eval_envs=num_episodes or 1,
        run_evals=num_episodes > 0,
        deterministic_eval=True,  # as our evaluations are
        network_factory=partial(
            brax_networks.make_ppo_networks,
            policy_hidden_layer_sizes=sizes.policy,
            value_hidden_layer_sizes=sizes.value,
        ),
        progress_fn=progress,
        seed=seed,
        **{name: getattr(sizes, name) for name in names.split()},
    )


def brax_rate(body: str, backend: str, sizes: Published, updates: int, stretches: int) -> Rate:
    """Measures brax's training: the median of the stretches after its two compilations."""
    rates: list[float] = []
    train_brax(
        body, backend, sizes, updates, stretches, lambda _, m: rates.append(m["training/sps"])
    )
    return Rate("brax", backend, statistics.median(rates[2:]), None)


def share_physics(rates: list[Rate]) -> list[Rate]:
    """Gives each rate without a physics alone that of another line on the same physics."""
    known = {rate.physics: rate.physics_alone for rate in rates if rate.physics_alone}
    return [rate._replace(physics_alone=known.get(rate.physics)) for rate in rates]


def table(body: str, rates: list[Rate]) -> str:
    """Formats one body."""
    brax = next((rate.training for rate in rates if rate.name == "brax"), None)
    lines = [f"| {body} | physics | steps/s | physics alone | share | times brax |"]
    lines.append("|---|---|---|---|---|---|")
    for rate in rates:
        alone = f"{rate.physics_alone:,.0f}" if rate.physics_alone else "not measured"
        share = f"{rate.training / rate.physics_alone:.2f}" if rate.physics_alone else ""
        ratio = f"{rate.training / brax:.2f}" if brax else ""
        cells = (rate.name, rate.physics, f"{rate.training:,.0f}", alone, share, ratio)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main(arguments: list[str]) -> int:
    """Measures the bodies that the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bodies", nargs="+", choices=tuple(BODIES))
    trainers = ("brax", "purerl")
    parser.add_argument("--trainers", nargs="+", choices=trainers, default=trainers)
    parser.add_argument("--backend", default="mjx", help="brax's physics")
    parser.add_argument("--updates", type=int, default=10, help="in one stretch of brax's")
    parser.add_argument("--stretches", type=int, default=5, help="of brax's; two of them compile")
    parser.add_argument("--rounds", type=int, default=10, help="updates timed of ours")
    parser.add_argument("--num-envs", type=int, default=0, help="0: as published; less for a try")
    parser.add_argument(
        "--json", type=output_file, default="", help="also write the figures to this file"
    )
    options = parser.parse_args(arguments)
    if options.stretches < 3:
        parser.error(f"--stretches is {options.stretches}; two compile, so it takes at least 3.")
    if "purerl" in options.trainers:
        exact.set_xla_flags()  # before JAX starts; it holds for all in this process
    found: dict[str, list[dict]] = {}
    for body in options.bodies:
        sizes, rates = resize(BODIES[body], options.num_envs), []
        if "brax" in options.trainers:
            rates.append(brax_rate(body, options.backend, sizes, options.updates,
                                   options.stretches))  # fmt: skip
        if "purerl" in options.trainers:
            rates += our_rates(body, options.backend, sizes, options.rounds)
        rates = share_physics(rates)
        print(f"{table(body, rates)}\non {jax.devices()[0].device_kind}", flush=True)
        found[body] = [rate._asdict() for rate in rates]
        if options.json:
            with open(options.json, "w") as file:
                device = jax.devices()[0].device_kind
                json.dump({"device": device, "bodies": found}, file, indent=1)
    return 0


if __name__ == "__main__":
    leave(lambda: main(sys.argv[1:]))
