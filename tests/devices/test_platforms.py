"""The check of a GPU against a CPU, on a CPU."""

import jax
import numpy as np
import pytest

from purerl.experiment import objects
from purerl.ppo import algorithm
from tests.long import platforms
from tests.runs import toy_experiment
from tests.training.test_run import TOY


@pytest.mark.slow
def test_what_is_learned_otherwise_is_named(tmp_path, monkeypatch):
    file = tmp_path / "there.npz"
    platforms.ask_cpu([str(TOY), "--write", str(file)])
    setup, there = objects.build(toy_experiment.experiment), dict(np.load(file))
    assert platforms.compare(setup, there) == {}
    improve = algorithm.improve

    def wrong(*arguments):
        state, metrics = improve(*arguments)
        return state.replace(params=jax.tree.map(lambda x: x + 0.01, state.params)), metrics

    monkeypatch.setattr(algorithm, "improve", wrong)
    found = platforms.compare(setup, there)
    assert {path.split("/")[1] for path in found} == {"params"}
    for path, difference in found.items():  # relative to the greatest entry, if that is above 1
        greatest = max(1.0, float(np.abs(there[path]).max()))
        np.testing.assert_allclose(difference, 0.01 / greatest, rtol=1e-3)
