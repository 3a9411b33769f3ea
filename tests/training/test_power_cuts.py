"""Some power cuts; `python -m tests.long.power_cuts` makes one after every change of a file."""

import pytest

from tests.faults import shim
from tests.faults.verdicts import SHORT
from tests.long.power_cuts import cut_all


@pytest.mark.slow
@pytest.mark.skipif(not shim.has_compiler(), reason="the shim is compiled with cc")
def test_what_a_power_cut_leaves_is_resumed_to_the_same_run():
    found = cut_all(SHORT, 80, ("strict", "names", "written"))
    assert found.cuts > 50 and found.trees > 50
    assert not found.failures
