"""A place for sweeps whose runs are stand-ins."""

from pathlib import Path

import pytest

from purerl.tune.sweep import scheduler

FAKE = Path(__file__).parent / "fake_run.py"


@pytest.fixture
def place(tmp_path, monkeypatch):
    """An empty folder, in which a run takes a tenth of a second."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(scheduler, "RUN", (str(FAKE),))
    monkeypatch.setattr(scheduler, "POLL", 0.02)
    return tmp_path
