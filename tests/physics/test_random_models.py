"""Models drawn at random step as in plain MuJoCo: a short form of `python -m tests.long.models`."""

import collections

import mujoco
import pytest

from purerl.physics import changes, engine_c
from tests.long import models

pytestmark = pytest.mark.slow


def tried(engine, number, first=0):
    """Returns what was counted over models; the first difference is raised."""
    tally = collections.Counter()
    with models.quickly():
        for _, load, rng in models.drawn(engine, first):
            models.try_model(load, engine, rng, tally)
            if tally["stepped"] == number:
                break
    return tally


def test_engine_c_is_mujoco():
    assert tried("c", 40)["changed"] > 60


def test_engine_jax_is_mujoco():
    tried("jax", 1, first=1)


def forget_constants(model, _, wanted):
    return {n: getattr(model, n) for n in wanted}


def late_forgotten(batch, stage, substeps, advance=engine_c._advance):
    return advance(batch, int(mujoco.mjtStage.mjSTAGE_NONE), substeps)


@pytest.mark.parametrize(
    ("module", "name", "broken"),
    [
        (engine_c, "_movable", lambda model, names: model),
        (engine_c, "_advance", late_forgotten),
        (changes, "derive", forget_constants),
    ],
)
def test_a_broken_engine_is_noticed(monkeypatch, module, name, broken):
    monkeypatch.setattr(module, name, broken)
    with pytest.raises(models.Difference):
        tried("c", 60)
