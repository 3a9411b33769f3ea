"""The worker: it is replaced when a command hangs, and tells of threads that are left behind."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.faults import commands, shim
from tests.faults.commands import workplace
from tests.faults.worker import busy_after


@pytest.mark.slow
@pytest.mark.skipif(not shim.has_compiler(), reason="the shim is compiled with cc")
def test_a_command_that_hangs_is_told_and_the_next_one_is_carried_out(monkeypatch):
    monkeypatch.setattr(commands, "HANGS", 2.0)
    with workplace() as (folder, worker):
        (folder / "sleepy.py").write_text("import time\ntime.sleep(1000)\n")
        assert worker.run(["--help"], folder).code == 0
        answer = worker.run([str(folder / "sleepy.py")], folder)
        assert answer.hung and "sleepy.py" in answer.err, "where it hangs"
        answer = worker.run(["nothing_of_this_name"], folder)
        assert answer.code == 2 and answer.err.startswith("purerl: There is no experiment")
        assert worker.end() == ""


def test_a_thread_that_would_keep_the_process_is_told_and_an_idle_one_is_not():
    free = threading.Event()
    left = threading.Thread(target=free.wait, name="left behind")
    before = set(threading.enumerate())
    with ThreadPoolExecutor(1) as pool:
        pool.submit(int).result()
        assert busy_after(set(threading.enumerate()) - before, 0.1) == ""
        left.start()
        told = busy_after(set(threading.enumerate()) - before, 0.1)
        assert told.startswith("left behind: ") and "wait" in told
        free.set()
        assert busy_after([left], 10.0) == ""
