"""The gallery has a picture of every body and task, small ones, and a script that draws them."""

import re

import pytest
from PIL import Image

from purerl.envs.suite import pendulum
from purerl.envs.suite.tasks import TASKS
from purerl.experiment.loading import available
from purerl.experiments.benchmarks import gallery
from tests.docs.blocks import ROOT

PAGE = (ROOT / "docs/gallery.md").read_text()
ROW = re.compile(
    r"^\| !\[(.+)\]\(gallery/\1\.jpg\) \| \1 \| .+ \| `(.+)` \| \[`(.+)`\]\(\.\./\3\) \|$", re.M
)
NAMES = [*gallery.BODIES, *TASKS]


def test_every_body_and_task_has_its_row():
    rows = ROW.findall(PAGE)
    assert [name for name, _, _ in rows] == NAMES
    assert all(command.endswith(name) for name, command, _ in rows)


def test_every_experiment_is_told_of():
    readme = (ROOT / "README.md").read_text()
    names = [name for name in available() if name != "custom_network"]  # which is to be copied
    assert len(names) >= 11
    assert not [name for name in names if f"`python -m purerl.run {name}" not in PAGE]
    assert not [name for name in names if f"`{name}`" not in readme]


def test_pictures_are_there_and_small():
    pictures = sorted((ROOT / "docs/gallery").iterdir())
    assert [path.name for path in pictures] == sorted(f"{name}.jpg" for name in NAMES)
    assert {Image.open(path).size for path in pictures} == {(gallery.WIDTH, gallery.HEIGHT)}
    assert sum(path.stat().st_size for path in pictures) <= 400_000


def test_poses_are_of_tasks_that_there_are():
    assert not set(gallery.POSES) - set(NAMES)


@pytest.mark.slow
@pytest.mark.usefixtures("opengl")
def test_a_picture_shows_the_pose_that_is_asked_for():
    env = pendulum.build(engine="c")
    hanging, up = (gallery.Pose(joints={"hinge": angle}, zoom=1.5) for angle in (3.14, 0.0))
    assert gallery.pose(env, hanging).qpos[0] == pytest.approx(3.14)
    pictures = [gallery.draw(env, wanted) for wanted in (hanging, up)]
    assert {picture.size for picture in pictures} == {(gallery.WIDTH, gallery.HEIGHT)}
    assert pictures[0].tobytes() != pictures[1].tobytes()
