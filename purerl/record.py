"""Records episodes as arrays in one file: `python -m purerl.record RUN [--out episodes.npz]`.

Any option of the environment can be given, and a lesion. Without these the episodes begin as those
of `python -m purerl.evaluate RUN` with the same options. Another program computes them, so the last
bits differ, and a body with contacts goes its own way in the end: count returns from `reward` here.
Every array but `length` is [N, T, ...]: N episodes of at most T steps.

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

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from purerl.core.errors import UserError, check_least
from purerl.experiment.command_line import main_of_words
from purerl.experiment.options import EpisodeOptions, Lesion
from purerl.machine import command_errors, files
from purerl.machine.output import show
from purerl.tune import subject

PROG = "python -m purerl.record"
HDF5 = (".h5", ".hdf5")


@dataclass(frozen=True)
class RecordOptions(EpisodeOptions):
    """What is recorded, and where it is written."""

    out: Path = Path("episodes.npz")
    """A new file: arrays, or, if it ends in .h5, HDF5 with names and where the body's parts are."""
    clips: bool = False
    """Write the motion alone, as clips in HDF5."""
    episodes: int = 8
    """Whole episodes, N."""
    lesion: Lesion = Lesion()


def command(words: Sequence[str]) -> None:
    """Writes the file and tells what is in it."""
    from purerl.report import asking, episode_arrays

    found, experiment, options = subject.one_run(words, PROG, RecordOptions)
    check_least(options, UserError, episodes=1)
    if options.clips and options.out.suffix not in HDF5:
        raise UserError(f"out is {options.out}; a file of clips ends in {' or '.join(HDF5)}.")
    files.check_new(options.out)
    if options.out.suffix in HDF5:
        command_errors.check_installed("h5py", "clips")
    setup, state = asking.acting(found.run, experiment, options)
    arrays = episode_arrays.record(setup, state, options.seed, options.episodes)
    about = {"run": found.name, "update": found.run.update, "digest": found.run.digest}
    about["changes"] = "; ".join(asking.changes(found.run.experiment, experiment, options))
    write(options, arrays, setup.env, about)
    show(*(f"{name:32} {x.dtype} {list(x.shape)}" for name, x in arrays.items()), str(options.out))


def write(options: RecordOptions, arrays: dict[str, Any], env: Any, about: dict[str, Any]) -> None:
    """Writes what was recorded, in the layout that was asked for."""
    if options.clips:
        from purerl.clips import body, files as clip_files
        from purerl.report.renderer import model_of

        model = model_of(env)
        both = zip(arrays["physics/qpos"], arrays["length"], strict=True)
        tracks = {f"Episode_{i}": x[:length] for i, (x, length) in enumerate(both) if length}
        packed = body.pack(model, [*tracks.values()], [*tracks], 1.0 / env.control_timestep)
        clip_files.write(options.out, packed, model)
    elif options.out.suffix in HDF5:
        from purerl.clips import episodes

        episodes.write(options.out, arrays, env, **about)
    else:
        files.write_arrays(options.out, arrays)


main = main_of_words(command, lambda words: subject.show_help(RecordOptions, __doc__, PROG, words))


if __name__ == "__main__":
    command_errors.leave(main)
