"""Motion of a person, as dm_control ships it, fitted to dm_control's humanoid."""

import numpy as np
import pytest

pytest.importorskip("h5py", reason="pip install -e '.[clips]'")

import mujoco
from dm_control.locomotion.arenas import floors
from dm_control.locomotion.walkers import cmu_humanoid

from purerl import clips
from purerl.clips import examine
from purerl.envs import recordings


@pytest.fixture(scope="module")
def person():
    """Returns MuJoCo's model of the humanoid on a floor, and motion of it."""
    walker, arena = cmu_humanoid.CMUHumanoid(), floors.Floor()
    walker.create_root_joints(arena.attach(walker))
    xml, assets = arena.mjcf_model.to_xml_string(), arena.mjcf_model.get_assets()
    return mujoco.MjModel.from_xml_string(xml, assets), recordings.cmu()


def test_a_person_is_where_the_file_says(person):
    model, motion = person
    walk, roll = examine.examine(motion, model)
    assert walk.startswith("cmuv2019_001: cmuv2019, 0.45 s, 10 frames at 20 Hz; 2.75 m/s")
    assert "; 11.40 mm below the floor (rhumerus, frame 3); 0.82 deg beyond" in roll
    for line in (walk, roll):
        assert "; 0.00 mm from the file's positions (" in line
    # Left for right is seen at once.
    flip = [{"lfemurrx": "rfemurrx", "rfemurrx": "lfemurrx"}.get(n, n) for n in motion.columns]
    wrong, _ = examine.examine(motion._replace(columns=tuple(flip)), model)
    assert float(wrong.split(" mm from")[0].rpartition(" ")[2]) > 1.0


def test_it_may_be_read_at_another_rate(person):
    model, motion = person
    fitted = clips.fit(motion, model, 100.0)
    assert motion.rate == 20.0 and fitted.qpos.shape == (2, 46, 63)
    np.testing.assert_allclose(fitted.qpos[:, ::5, 7:], motion.values[..., 7:], atol=1e-6)
