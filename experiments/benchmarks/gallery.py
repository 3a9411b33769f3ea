"""Small pictures of every task and every body, for the gallery of the pages.

    python -m purerl.experiments.benchmarks.gallery docs/gallery

draws them again, each from the state that `POSES` names. It needs an OpenGL without a screen, as
`python -m purerl.render` does.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from PIL import Image

import purerl
from purerl.envs.suite import tasks
from purerl.physics.drawing import Picture, take_picture
from purerl.report.video import renderer_of

WIDTH, HEIGHT = 240, 180  # of a picture [pixels]
FINE = 3  # drawn so many times larger, and then made smaller: smooth edges
QUALITY = 82  # of the JPEG
BODIES = ("cartpole_swingup", "ant_run", "ant_gaps", "rodent_run", "rodent_gaps")


class Pose(NamedTuple):
    """The state that a picture shows: the start of an episode, changed."""

    seed: int = 0  # of the episode
    upright: bool = False  # the model's own pose in place of the drawn one
    joints: dict[str, float] = {}  # name -> position [m] or [rad]; of a free joint: x
    camera: str = ""  # a camera's name in the model; "" is the one of `render`
    zoom: float = 1.0  # shows the middle, so many times larger


STRIDE = {"right_hip": -0.5, "right_knee": -0.3, "left_hip": 0.4, "left_knee": -0.9}
LEAP = {"right_hip_y": -0.9, "right_knee": -0.6, "left_hip_y": 0.3, "left_knee": -1.2}
POSES = {
    "ant_run": Pose(camera="walker/floating", zoom=1.4),
    "ant_gaps": Pose(camera="walker/sideon", joints={"walker/": 7.6}, zoom=1.7),
    "rodent_run": Pose(zoom=2.2),
    "rodent_gaps": Pose(camera="walker/side", joints={"walker/": 6.7}, zoom=1.8),
    "acrobot-swingup_sparse": Pose(upright=True),
    "cartpole-balance_sparse": Pose(seed=3),
    "cartpole-swingup_sparse": Pose(seed=3),
    "cartpole_swingup": Pose(zoom=1.4),
    "finger-turn_hard": Pose(seed=1),
    "fish-swim": Pose(camera="fixed_top", zoom=1.2),
    "fish-upright": Pose(camera="tracking_y", zoom=1.5),
    "hopper-hop": Pose(upright=True, joints={"hip": -0.6, "knee": 0.9, "rootz": 0.3}),
    "hopper-stand": Pose(upright=True),
    "humanoid-run": Pose(upright=True, joints=LEAP, camera="side"),
    "humanoid-stand": Pose(upright=True, camera="side"),
    "humanoid-walk": Pose(
        upright=True, joints={k: 0.5 * v for k, v in LEAP.items()}, camera="side"
    ),
    "manipulator-bring_ball": Pose(camera="fixed", zoom=1.3),
    "pendulum-swingup": Pose(zoom=1.6),
    "reacher-hard": Pose(seed=1),
    "walker-run": Pose(upright=True, joints=STRIDE),
    "walker-stand": Pose(upright=True),
    "walker-walk": Pose(upright=True, joints={k: 0.5 * v for k, v in STRIDE.items()}),
}


def environments() -> Iterator[tuple[str, Any]]:
    """Yields name and environment of each body's experiment, then of each task of the suite."""
    for name in BODIES:
        experiment = purerl.find(name)
        yield name, experiment.build_env(experiment.env, "c")
    for name in tasks.TASKS:
        yield name, tasks.build(tasks.Options(name), engine="c")


def pose(env: Any, wanted: Pose) -> Picture:
    """Returns how the wanted state of an environment looks, as numpy arrays."""
    model, state = env.physics.model, jax.jit(env.reset)(jax.random.key(wanted.seed))
    qpos = np.array(model.qpos0 if wanted.upright else state.physics.qpos)
    for name, position in wanted.joints.items():
        qpos[model.joint(name).qposadr[0]] = position
    state = state.replace(physics=state.physics.replace(qpos=jax.numpy.asarray(qpos)))
    return jax.device_get(take_picture(env, state))


def draw(env: Any, wanted: Pose) -> Image.Image:
    """Returns the picture of an environment, WIDTH x HEIGHT."""
    large = int(FINE * WIDTH * wanted.zoom), int(FINE * HEIGHT * wanted.zoom)
    with renderer_of(env, large, wanted.camera) as renderer:
        (frame,) = renderer.draw_episode([pose(env, wanted)])
    left, top = (large[0] - FINE * WIDTH) // 2, (large[1] - FINE * HEIGHT) // 2
    middle = (left, top, left + FINE * WIDTH, top + FINE * HEIGHT)
    size = (WIDTH, HEIGHT)
    return Image.fromarray(frame).resize(size, Image.Resampling.LANCZOS, box=middle)


def main() -> None:
    """Draws all pictures, or those that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", help="of tasks or experiments; without: all")
    asked = parser.parse_args()
    asked.folder.mkdir(parents=True, exist_ok=True)
    for name, env in environments():
        if not asked.names or name in asked.names:
            path = asked.folder / f"{name}.jpg"
            draw(env, POSES.get(name, Pose())).save(path, quality=QUALITY, optimize=True)
            print(f"{path}: {path.stat().st_size / 1000:.1f} kB", flush=True)


if __name__ == "__main__":
    main()
