"""Packs a run for a colleague: `python -m purerl.pack RUN`, who opens it: `pack FILE --open`.

Give it in the folder that you train in. The file has the run with its newest and best checkpoint,
the experiment, and what that reads in this folder or below: modules, MJCF, meshes, data. It opens
as a folder of its name. In there evaluate, render and run --resume work as here.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from purerl.experiment.command_line import main_of
from purerl.machine import command_errors, files, output

ENDING = ".tar.gz"


@dataclass(frozen=True)
class PackOptions:  # noqa: D101 (--help prints the page above)
    __doc__ = __doc__

    run: Annotated[Path, tyro.conf.Positional]
    """The run's folder, such as runs/arm/seed1; with --open a file, such as arm-seed1.tar.gz."""
    open: bool = False
    """Open the file, into a new folder here."""
    trust: bool = False
    """Execute the run's experiment.py though this machine does not know it: read it first."""


def command(options: PackOptions) -> None:
    """Packs, or opens; tells what is in the file, or how to go on."""
    from purerl.runs.packing import as_archive, how_to_go_on, pack, unpack

    if options.open:
        folder = Path(options.run.name.removesuffix(ENDING))
        unpack(options.run, folder)
        output.show(*how_to_go_on(folder))
    else:
        packed = pack(options.run, options.trust)
        file = Path("-".join(options.run.absolute().parts[-2:]) + ENDING)
        files.write_answer(file, as_archive(packed))
        output.show(*sorted(map(str, packed)), f"{file} ({file.stat().st_size:,} bytes)")


main = main_of(PackOptions, command, "python -m purerl.pack")


if __name__ == "__main__":
    command_errors.leave(main)
