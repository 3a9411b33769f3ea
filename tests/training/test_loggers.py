"""Loggers: metrics.jsonl is exact, the others can do no harm."""

import hashlib
import json
import threading
import time

import numpy as np
import pytest

from purerl.checks import check_env
from purerl.core.errors import UserError
from purerl.runs.metrics_file import MetricsFile
from purerl.training import loop
from purerl.training.loggers import BackgroundLogger, _TensorBoardSink
from purerl.training.loop import summarize
from purerl.training.plan import Plan


def test_counts_are_summed_and_episodes_weigh_by_their_number():
    names = ("episodes", "episode_return", "episode/x", "kl", "skipped_in_a_row")
    rows = [
        (1.0, 10.0, 1.0, 1.0, 4.0),
        (3.0, 2.0, 5.0, 2.0, 0.0),
        (0.0, float("nan"), 0.0, 6.0, 2.0),
    ]
    window = [dict(zip(names, row, strict=True)) for row in rows]
    assert summarize(window) == {
        "episodes": 4.0,
        "episode_return": 4.0,
        "episode/x": 4.0,
        "kl": 3.0,
        "skipped_in_a_row": 2.0,
    }


def test_nothing_is_said_of_episodes_when_none_ended():
    assert summarize([{"episodes": 0.0, "episode_return": 0.0}])["episode_return"] is None


EMPTY = hashlib.sha256().hexdigest()


def append(file, record):
    file.add(record)
    file.write()


def test_lines_are_whole_and_strict_json(tmp_path):
    file = MetricsFile(tmp_path / "m", 0, EMPTY)
    append(file, {"a": float("nan"), "b": 1})
    first = file.flush()
    append(file, {"a": float("inf"), "b": 2})
    lines = (tmp_path / "m").read_bytes().splitlines(keepends=True)
    assert first["metrics_bytes"] == len(lines[0])
    assert first["metrics_sha256"] == hashlib.sha256(lines[0]).hexdigest()
    assert [json.loads(line) for line in lines] == [{"a": None, "b": 1}, {"a": None, "b": 2}]
    MetricsFile(tmp_path / "m", first["metrics_bytes"], first["metrics_sha256"])
    assert (tmp_path / "m").read_bytes() == lines[0]


def test_a_shortened_file_is_refused(tmp_path):
    (tmp_path / "m").write_text("{}\n")
    with pytest.raises(UserError, match="of the 10 bytes .* it has 3 bytes"):
        MetricsFile(tmp_path / "m", 10, EMPTY)


def test_a_full_disk_leaves_no_gap_and_no_torn_line(tmp_path):
    file = MetricsFile(tmp_path / "m", 0, EMPTY)
    append(file, {"n": 1})
    raw, room = file.file, [3]

    class Full:
        truncate = raw.truncate

        def write(self, content):
            if room:
                return raw.write(content[: room.pop()])
            raise OSError("No space left on device")

    file.file = Full()
    for number in (2, 3):
        with pytest.raises(OSError, match="No space left"):  # and not how many bytes there were
            append(file, {"n": number})
        assert (tmp_path / "m").read_text() == '{"n": 1}\n'
    file.file = raw
    append(file, {"n": 4})
    assert (tmp_path / "m").read_text() == "".join(f'{{"n": {n}}}\n' for n in (1, 2, 3, 4))


class Sink:
    def __init__(self, log=lambda record: None):
        self.log, self.closed = log, False

    def close(self):
        self.closed = True


def test_a_logger_gets_every_record_and_is_closed():
    got = []
    sink = Sink(got.append)
    logger = BackgroundLogger("T", lambda: sink, pytest.fail)
    for number in range(5):
        logger.log({"n": number})
    logger.close()
    assert got == [{"n": n} for n in range(5)] and sink.closed


def test_a_logger_that_raises_is_dropped_once():
    said = []

    def fail(record):
        raise RuntimeError("no network to be found")

    logger = BackgroundLogger("T", lambda: Sink(fail), said.append)
    for _ in range(3):
        logger.log({})
        logger.thread.join(1.0)
    logger.close()
    assert said == ["The T logger is dropped: no network to be found. Training goes on."]


def test_a_logger_that_hangs_never_makes_training_wait():
    said, release = [], threading.Event()
    logger = BackgroundLogger("T", lambda: Sink(lambda record: release.wait(20)), said.append, 4)
    begin = time.perf_counter()
    for _ in range(100):
        logger.log({})
    logger.close()
    assert time.perf_counter() - begin < 1.0
    assert len(said) == 1 and "too slow" in said[0]
    release.set()


def test_tensorboard_files_are_written(tmp_path):
    pytest.importorskip("tensorboardX")
    sink = _TensorBoardSink(tmp_path)
    sink.log({"update": 1, "train/kl": 0.5, "eval/x": None})
    sink.close()
    assert b"train/kl" in next((tmp_path / "tensorboard").iterdir()).read_bytes()


def test_what_an_evaluation_adds_is_reserved_and_deviations_are_of_samples():
    own = {"episode_return": [1.0, 3.0], "episode_length": [4.0, 4.0], "lost": [0.0, 0.0]}
    record = loop._summarize_evaluation({k: np.array(x) for k, x in own.items()})
    assert {name.removeprefix("eval/") for name in record} == check_env.RESERVED
    assert record["eval/episode_return_std"] == pytest.approx(2**0.5)  # over n - 1
    alone = loop._summarize_evaluation({k: np.array(x[:1]) for k, x in own.items()})
    assert alone["eval/episode_return_std"] == 0.0


def test_the_spread_over_seeds_is_that_of_a_sample():
    names = [*loop._summarize_evaluation(dict.fromkeys(("episode_return",), np.ones(1))), "lost"]
    both = [dict.fromkeys((*names, "eval/lost", "eval/episode_length"), 0.0) for _ in range(2)]
    both = [one | {"update": 1, "steps": 8} for one in both]
    both[1]["eval/episode_return"] = 2.0
    plan = Plan(1, 8, 1, (), ())
    assert "return 1.00 +- 1.41 over 2 seeds" in loop._describe_evaluation(both, plan)
