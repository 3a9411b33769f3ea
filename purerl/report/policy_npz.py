"""A policy of a default network as arrays by name; `numpy_policy.py` is their reader."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from purerl.core.errors import UserError
from purerl.machine.files import write_arrays
from purerl.ppo import networks, running_moments
from purerl.report.numpy_policy import Policy
from purerl.report.policy_file import control_range, origin
from purerl.runs.loaded_run import Run


def write_npz(run: Run, file: Path) -> Callable[[Any], np.ndarray]:
    """Writes a run's policy as npz; returns the file's policy, of observations [N, ...].

    Raises:
      UserError: the network is none of `networks.mlp` and `networks.recurrent`.
    """
    write_arrays(file, policy_arrays(run))
    policy = Policy(file)
    return lambda observation: policy(networks.policy_features(observation))


def policy_arrays(run: Run) -> dict[str, Any]:
    """Returns all that the policy needs, by name.

    `mean`, `std` [O] and `clip` normalize; `layer0/kernel` [O, H], `layer0/bias` [H], ... are
    `layers` many, each followed by `activation`; a `cell` ("", "gru" or "lstm") with `memory_size`
    [1 number] has its gates by Flax's names (`ir/kernel`, ...); `loc` and tanh give the action;
    `control_range` [A, 2], where the environment has a model, is what -1 and 1 stand for.
    """
    kinds = (networks.mlp, networks.recurrent)
    if run.experiment.build_network not in kinds:
        raise UserError(
            "npz knows the layers of networks.mlp and networks.recurrent, and this run's network "
            "is one of your own: use --format jax or --format onnx."
        )
    options, params = run.experiment.network, run.state.params["params"]
    cell = getattr(options, "cell", "")
    layers = params.get("encoder" if cell else "policy", {})  # Flax has none of no layers
    dense = {f"layer{i}": layers[f"Dense_{i}"] for i in range(len(layers))}
    dense |= params.get("cell", {}) | {"loc": params["head"]["loc"]}
    return _normalizer(run) | {
        "activation": options.activation,
        "layers": len(layers),
        "cell": cell,
        "memory_size": [options.hidden] if cell else [0],
        **{f"{name}/{k}": np.asarray(x) for name, layer in dense.items() for k, x in layer.items()},
        **({} if control_range(run) is None else {"control_range": control_range(run)}),
        "control_timestep": run.env.control_timestep,
        **origin(run),
    }


def _normalizer(run: Run) -> dict[str, Any]:
    """Returns what `running_moments.normalize` computes with, of what the policy may read."""
    statistics = run.state.normalizer
    of_policy: Callable[[Any], Any] = networks.policy_features
    mean, variance = of_policy(statistics.mean).value, of_policy(statistics.variance).value
    std = np.sqrt(np.asarray(variance) + np.float32(running_moments.VARIANCE_FLOOR))
    return {"mean": np.asarray(mean), "std": std, "clip": np.float32(running_moments.CLIP)}
