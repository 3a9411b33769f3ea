"""Lists, checks, cuts and draws recorded motion: `python -m purerl.clips FILE [--body BODY]`.

FILE is HDF5, of one of the two layouts on docs/howto/clips.md.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from purerl.core.errors import UserError
from purerl.experiment.command_line import main_of
from purerl.machine import command_errors, files, output


@dataclass(frozen=True)
class ClipsOptions:
    """Lists the clips of a file; with a body, checks them against it, cuts and draws them."""

    file: Annotated[Path, tyro.conf.Positional]
    """An HDF5 file of recorded motion."""
    body: str = ""
    """Whose motion it is: that of an experiment, by its name or file, such as rodent_run."""
    rate: float = 0.0
    """At which it was recorded [Hz], where the file does not say so."""
    frames: int = 0
    """Of each clip, where the file does not say so."""
    allow: tuple[str, ...] = ()
    """Joints that only one of both has, the file and the body."""
    cut: tuple[str, float, float] | None = None
    """A clip and its part from, to [s], such as Walk_12.p 1.0 2.5, to be written to --out, by
    default cut.h5."""
    draw: str = ""
    """A clip: writes its video CLIP.mp4 and contact sheet CLIP.png here."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """A file to write: what --cut takes or, without it, all clips, with their rate."""


def command(options: ClipsOptions) -> None:
    """Tells what is in the file, or writes what is asked for."""
    if options.draw:
        from purerl.report.opengl import choose_gl

        choose_gl()  # MuJoCo looks for OpenGL when it is imported
    from purerl.clips import body, examine, files as clip_files, records
    from purerl.experiment import loading, objects
    from purerl.report.renderer import model_of

    motion = clip_files.read(options.file, options.rate, options.frames)
    if not options.body:
        if options.cut or options.draw or options.out:
            raise UserError("--cut, --out, --draw need the body: give it, as --body rodent_run.")
        output.show(*(examine.about(motion, i) for i in range(len(motion.names))))
        return
    model = model_of(objects.build(loading.find(options.body)).env)
    clips = body.fit(motion, model, motion.rate, options.allow)
    if options.cut or options.out:
        files.check_new(out := options.out or Path("cut.h5"))
        clip_files.write(out, records.cut(clips, *options.cut) if options.cut else clips, model)
        output.show(str(out))
    if options.draw:
        draw(records.cut(clips, options.draw), model)
    if not (options.cut or options.out or options.draw):
        for line in examine.examine(motion, model, options.allow):
            output.show(line)


def draw(clip: Any, model: Any) -> None:
    """Writes the video and the contact sheet of one clip."""
    import mujoco
    import numpy as np

    from purerl.physics.drawing import Picture
    from purerl.report import episode_pictures, renderer, video

    data, length = mujoco.MjData(model), clip.qpos.shape[1]
    still = [np.tile(x, (length, 1, 1, 1)) for x in (data.mocap_pos, data.mocap_quat)]
    arrays: Any = [np.asarray(clip.qpos).swapaxes(0, 1), *still, {}, ()]
    rest: Any = np.ones((length, 1), bool), np.zeros(1), np.full(1, length), np.ones(1, bool)
    path = Path(f"{Path(clip.names[0]).name}.mp4")
    with renderer.Renderer(model, 640, 480) as drawing:
        shown = episode_pictures.Recording(Picture(*arrays), *rest)
        video.draw(path, drawing, shown, 1.0 / clip.rate)
    output.show(str(path.with_suffix(".png")), str(path))


main = main_of(ClipsOptions, command, "python -m purerl.clips")


if __name__ == "__main__":
    command_errors.leave(main)
