"""A policy of a default network as arrays by name; `numpy_policy.py` is their reader."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from purerl import eyes
from purerl.core.errors import UserError
from purerl.machine.files import write_arrays
from purerl.ppo import networks, running_moments
from purerl.report.numpy_policy import Policy
from purerl.report.policy_file import control_range, origin
from purerl.runs.loaded_run import Run


def write_npz(run: Run, file: Path) -> Callable[[Any], np.ndarray]:
    """Writes a run's policy as npz; returns the file's policy, of observations [N, ...].

    Raises:
      UserError: the network is none of `networks` and `eyes`.
    """
    write_arrays(file, policy_arrays(run))
    return Policy(file)


def policy_arrays(run: Run) -> dict[str, Any]:
    """Returns all that the policy needs, by name.

    `mean`, `std` [O] and `clip` normalize; `layer0/kernel` [O, H], `layer0/bias` [H], ... are
    `layers` many, each followed by `activation`; `loc` and tanh give the action. A `cell` ("",
    "gru" or "lstm") with `memory_size` [1 number] has its gates by Flax's names (`ir/kernel`, ...)
    and `before` layers before it; what it remembers is read beside the observation.
    `encoders` many look at pictures, in `windows` [L, 2] of a kernel and a stride: `eye0/Dense_0`.
    `control_range` [A, 2], where the environment has a model, is what -1 and 1 stand for.
    """
    kinds = (networks.mlp, networks.recurrent, eyes.mlp, eyes.recurrent)
    if run.experiment.build_network not in kinds:
        raise UserError(
            "npz knows the layers of mlp and recurrent, of networks and of eyes, and this run's "
            "network is one of your own: use --format jax or --format onnx."
        )
    options, seeing = run.experiment.network, run.state.params["params"]
    params = seeing.get("network", seeing)  # behind the eyes
    cell = getattr(options, "cell", "")
    acting = params.get("mlp", params)  # beside a cell
    layers = acting.get("policy", {})  # Flax has none of no layers
    dense = {f"layer{i}": layers[f"Dense_{i}"] for i in range(len(layers))}
    before = params.get("encoder", {})
    dense |= {f"before{i}": before[f"Dense_{i}"] for i in range(len(before))}
    dense |= params.get("cell", {}) | {"loc": acting["head"]["loc"]}
    encoders = [x for name, x in sorted(seeing.items()) if name.startswith("Convolutions_")]
    windows: Any = np.transpose([options.eyes.kernels, options.eyes.strides]) if encoders else []
    for i, encoder in enumerate(encoders):
        dense |= {f"eye{i}/{name}": layer for name, layer in encoder.items()}
    return _normalizer(run) | {
        "activation": options.activation,
        "layers": len(layers),
        "before": len(before),
        "encoders": len(encoders),
        "windows": windows,
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
