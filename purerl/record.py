"""Records episodes as arrays in one file: `python -m purerl.record RUN [--out episodes.npz]`.

They begin as those of `python -m purerl.evaluate RUN` with the same options. Another program
computes them, so the last bits differ, and a body with contacts goes its own way in the end: count
returns from `reward` here. Every array but `length` is [N, T, ...]: N episodes of at most T steps.

    length [N]          steps of the episode; what comes after them is no part of it
    observation         before the step, as the environment gives it (the network gets it
                        normalized), [O] or a dict's parts
    physics/qpos ...    the simulation's state before the step
    task/...            what the environment remembers besides: the corridor's gaps, a target
    metrics/...         the environment's, before the step
    action [A]          in [-1, 1]; `reward` of the step that it began; `value` of the observation
    terminated          whether the step ended the episode; if none did, its time limit was reached,
                        or the simulation was lost
    memory/...          of a recurrent network, before the step
    network/MODULE      what each module of a Flax network returned: `network/policy/Dense_0` is a
                        layer before its activation, `network/policy` the last one after it,
                        `network/head.scale` a part of what `head` returned; modules inside Flax's
                        own loops (`nn.scan`, `nn.vmap`) are left out

MuJoCo's model, to compute from `qpos` where limbs are, is `purerl.load(RUN).env.physics.model`.
"""

from dataclasses import dataclass
from pathlib import Path

from purerl.core.errors import UserError, check_least
from purerl.experiment.command_line import main_of
from purerl.experiment.options import PlayOptions
from purerl.machine import command_errors, files
from purerl.machine.output import show


@dataclass(frozen=True)
class RecordOptions(PlayOptions):  # noqa: D101 (--help prints the page above)
    __doc__ = __doc__

    out: Path = Path("episodes.npz")
    """File to write."""
    episodes: int = 8
    """Whole episodes, N."""


def command(options: RecordOptions) -> None:
    """Writes the file and tells what is in it."""
    from purerl.report.episode_arrays import record
    from purerl.runs.loaded_run import load

    check_least(options, UserError, episodes=1)
    files.check_writable(options.out)
    run = load(options.run, options.checkpoint, options.engine, options.trust)
    arrays = record(run.restored.setup, run.state, options.seed, options.episodes)
    files.write_arrays(options.out, arrays)
    show(*(f"{name:32} {x.dtype} {list(x.shape)}" for name, x in arrays.items()), str(options.out))


main = main_of(RecordOptions, command, "python -m purerl.record")


if __name__ == "__main__":
    command_errors.leave(main)
