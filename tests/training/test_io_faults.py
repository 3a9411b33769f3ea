"""Some faults of the disk; `python -m tests.long.io_faults` makes every call of a run fail."""

import pytest

from tests.faults import shim
from tests.faults.verdicts import SHORT
from tests.long.io_faults import SITUATIONS, fault_all


@pytest.mark.slow
@pytest.mark.skipif(not shim.has_compiler(), reason="the shim is compiled with cc")
def test_a_run_survives_a_call_that_fails():
    found = fault_all(SHORT, SITUATIONS, every=1, sample=40, seed=1)
    assert found.met > 25 and found.told > 5
    assert not found.failures
