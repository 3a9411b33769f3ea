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
    """Whose motion it is: an experiment, such as rodent_run, or a MuJoCo model (body.xml)."""
    rate: float = 0.0
    """At which it was recorded [Hz], where the file does not say so."""
    frames: int = 0
    """Of each clip, where the file does not say so."""
    allow: tuple[str, ...] = ()
    """Joints that only one of both has, the file and the body."""
    cut: tuple[str, str] | None = None
    """A clip and its part from:to [s], such as Walk_12.p 1.0:2.5, to be written to --out."""
    draw: str = ""
    """A clip: writes its video CLIP.mp4 and contact sheet CLIP.png here."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("cut.h5")
    """The file that --cut writes."""


def command(options: ClipsOptions) -> None:
    """Tells what is in the file, or writes what is asked for."""
    if options.draw:
        from purerl.report.opengl import choose_gl

        choose_gl()  # MuJoCo looks for OpenGL when it is imported
    from purerl.clips import body, examine, files as clip_files, records

    motion = clip_files.read(options.file, options.rate, options.frames)
    if not options.body:
        if options.cut or options.draw:
            raise UserError("--cut and --draw need the body: give it, as --body rodent_run.")
        output.show(*(examine.about(motion, i) for i in range(len(motion.names))))
        return
    model = model_of(options.body)
    clips = body.fit(motion, model, motion.rate, options.allow)
    if options.cut:
        files.check_writable(options.out)
        part = records.cut(clips, options.cut[0], *seconds(options.cut[1]))
        clip_files.write(options.out, part, model)
        output.show(str(options.out))
    if options.draw:
        draw(records.cut(clips, options.draw), model)
    for line in (
        () if options.cut or options.draw else examine.examine(motion, model, options.allow)
    ):
        output.show(line)


def model_of(name: str) -> Any:
    """Returns the model of an experiment's environment or of a file; UserError if there is none."""
    import mujoco

    from purerl.experiment import loading, objects
    from purerl.report import renderer

    if not name.endswith(".xml"):
        return renderer.model_of(objects.build(loading.find(name)).env)
    try:
        return mujoco.MjModel.from_xml_path(name)
    except ValueError as error:
        raise UserError(f"{name} is no model of MuJoCo: {' '.join(str(error).split())}") from error


def seconds(part: str) -> tuple[float, float]:
    """Returns from and to [s] of "1.0:2.5"."""
    try:
        start, end = map(float, part.split(":"))
    except ValueError:
        raise UserError(f"The part is {part!r}; give from:to in seconds, as 1.0:2.5.") from None
    return start, end


def draw(clip: Any, model: Any) -> None:
    """Writes the video and the contact sheet of one clip."""
    import mujoco
    import numpy as np

    from purerl.physics.drawing import Picture
    from purerl.report import episode_pictures, renderer, video

    data, length = mujoco.MjData(model), clip.qpos.shape[1]
    qpos: Any = np.asarray(clip.qpos).swapaxes(0, 1)
    still: Any = [
        np.broadcast_to(x, (length, 1, *x.shape)) for x in (data.mocap_pos, data.mocap_quat)
    ]
    pictures = Picture(qpos, still[0], still[1], {}, ())
    rest: Any = np.ones((length, 1), bool), np.zeros(1), np.full(1, length), np.ones(1, bool)
    shown = episode_pictures.Recording(pictures, *rest)
    path = Path(f"{Path(clip.names[0]).stem}.mp4")
    with renderer.Renderer(model, 640, 480) as drawing:
        video.draw(path, drawing, shown, 1.0 / clip.rate)
    output.show(str(path.with_suffix(".png")), str(path))


main = main_of(ClipsOptions, command, "python -m purerl.clips")


if __name__ == "__main__":
    command_errors.leave(main)
