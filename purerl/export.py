"""Takes a policy away: `python -m purerl.export RUN [--format npz|jax|onnx] [--out F]`.

Normalization, memory and squashing are inside the file; docs/howto/export.md shows how to read it.
The policy acts by its distribution's centre. It is played on whole episodes, and how far the file's
actions are from the run's own is printed.

    npz    arrays by name, for numpy: mlp and recurrent, of networks and of eyes
    jax    a program of jax.export, for JAX on any device: any network
    onnx   a graph, operator set 17: networks of layers, cells and elementwise functions
"""

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from purerl.experiment.command_line import main_of
from purerl.experiment.options import PlayOptions
from purerl.machine import command_errors, files, output

NEEDS = {"npz": (), "jax": ("flatbuffers",), "onnx": ("onnx", "onnxruntime")}  # format: packages


@dataclass(frozen=True)
class ExportOptions(PlayOptions):  # noqa: D101 (--help prints the page above)
    __doc__ = __doc__

    format: Literal["npz", "jax", "onnx"] = "npz"
    """Kind of file."""
    out: Path | None = None
    """File to write (default: policy.npz, policy.jax or policy.onnx)."""


def command(options: ExportOptions) -> None:
    """Writes the file and tells how near it comes."""
    from purerl.report.policy_file import record_episodes
    from purerl.runs.loaded_run import load

    file = options.out or Path(f"policy.{options.format}")
    files.check_writable(file)
    for package in NEEDS[options.format]:
        command_errors.check_installed(package, "export")
    module = importlib.import_module(f"purerl.report.policy_{options.format}")
    run = load(options.run, options.checkpoint, options.engine, options.trust)
    policy = getattr(module, f"write_{options.format}")(run, file)
    output.show(record_episodes(run, options.seed).compare(policy))
    output.show(f"{file} ({file.stat().st_size:,} bytes)")


main = main_of(ExportOptions, command, "python -m purerl.export")


if __name__ == "__main__":
    command_errors.leave(main)
