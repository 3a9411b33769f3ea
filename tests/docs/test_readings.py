"""The tables of states and readings name what the code has, with the shapes that it returns."""

import re

import jax
import mujoco
import numpy as np
import pytest

from purerl import Physics
from purerl.physics.interface import READINGS
from tests.docs.blocks import ROOT

PAGE = (ROOT / "docs/reference/environments.md").read_text()
ROW = re.compile(r"^\| (`\w+`(?:, `\w+`)*) \| `\[([\w, ]*)\]` \|", re.MULTILINE)
# All numbers differ where a table could confuse them, and every reading has what it needs.
XML = """
<mujoco>
  <worldbody>
    <camera/>
    <geom type="plane" size="1 1 1"/>
    <body mocap="true"/> <body mocap="true"/>
    <body>
      <freejoint/> <geom size="0.1"/> <site name="a"/>
      <body pos="0.2 0 0">
        <joint name="hinge" axis="0 1 0"/> <joint axis="1 0 0"/> <joint axis="0 0 1"/>
        <geom size="0.1"/> <geom size="0.05"/> <geom size="0.05"/> <geom size="0.05"/>
        <site name="b" pos="0.1 0 0"/> <site/>
      </body>
    </body>
  </worldbody>
  <tendon><spatial name="t"><site site="a"/><site site="b"/></spatial></tendon>
  <actuator>
    <muscle joint="hinge" ctrlrange="0 1" lengthrange="0 1"/> <motor joint="hinge"/>
    <motor joint="hinge"/> <muscle joint="hinge" ctrlrange="0 1" lengthrange="0 1"/>
  </actuator>
  <sensor>
    <accelerometer site="a"/> <subtreelinvel body="world"/> <tendonpos tendon="t"/>
  </sensor>
</mujoco>
"""


def table(start: str, end: str) -> dict[str, str]:
    """Returns name -> shape of the tables between two headings."""
    rows = ROW.findall(PAGE[PAGE.index(start) : PAGE.index(end)])
    return {name: shape for names, shape in rows for name in re.findall(r"\w+", names)}


@pytest.fixture(scope="module")
def played():
    model = mujoco.MjModel.from_xml_string(XML)
    physics = Physics(model, READINGS, engine="c")
    start = jax.eval_shape(physics.init, np.float32(model.qpos0), np.zeros(model.nv))
    return model, start


def shapes(named: dict[str, str], model: mujoco.MjModel) -> dict[str, tuple[int, ...]]:
    """Returns the shapes in numbers: "nbody, 3" is (4, 3) of a model with four bodies."""
    return {
        name: tuple(int(n) if n.isdigit() else getattr(model, n) for n in re.findall(r"\w+", shape))
        for name, shape in named.items()
    }


def test_every_field_of_a_state_stands_in_its_table_with_its_shape(played):
    model, (state, _) = played
    there = {name: x.shape for name, x in vars(state).items()}
    assert shapes(table("### State", "### Readings"), model) == there


def test_every_reading_stands_in_a_table_with_its_shape(played):
    model, (_, readings) = played
    there = {name: x.shape for name, x in readings._asdict().items()}
    assert set(there) == set(READINGS)
    assert shapes(table("### Readings", "### Sensors and muscles"), model) == there


def test_no_two_numbers_of_the_model_are_equal_that_a_table_could_confuse(played):
    model, _ = played
    for names in (["nq", "nv", "nu", "na", "ntendon", "nsensordata"],
                  ["nbody", "njnt", "ngeom", "nsite", "ncam", "nmocap", "nv"]):  # fmt: skip
        assert len({getattr(model, name) for name in names}) == len(names)
