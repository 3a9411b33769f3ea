"""What is demanded of a disturbed run: every way to miss it is told."""

import json

import pytest

from tests.faults import shim
from tests.faults.commands import Answer
from tests.faults.verdicts import Whole, began_at, complaint, kind_of, saved, untold
from tests.long.io_faults import ERRORS, SITUATIONS, cases_of, choose

LINES = [{"update": 1, "x": 0.5}, {"update": 2, "x": 0.25, "digest": "d"}]
WHOLE = Whole([], [LINES])
DONE = Answer(0, "Done: 64 steps. Digest d\n", "")


def make_run(place, lines, seed=""):
    folder = place / "runs" / "toy" / f"run{seed}"
    (folder / "checkpoints" / "000000000002").mkdir(parents=True)
    text = "".join(json.dumps({**line, "wall_s": 1.0}) + "\n" for line in lines)
    (folder / "metrics.jsonl").write_text(text)
    return folder


def test_a_run_like_the_undisturbed_one_is_right(tmp_path):
    make_run(tmp_path, LINES)
    assert complaint(DONE, tmp_path, WHOLE) == "" and saved(tmp_path) == 2


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (Answer(None, "", "it hangs:", hung=True), "it hangs"),
        (Answer(None, "", "KeyError: 1"), "a traceback: KeyError: 1"),
        (Answer(0, "", "Traceback (most ...):\nKeyError: 1"), "a traceback: KeyError: 1"),
        (Answer(2, "", "purerl: No.\nGo on with: it"), "exit code 2: purerl: No."),
        (Answer(0, "", "", stuck="a thread"), "it would hang at its end"),
    ],
)  # fmt: skip
def test_a_command_that_fails_is_told(tmp_path, answer, said):
    make_run(tmp_path, LINES)
    assert complaint(answer, tmp_path, WHOLE) == said


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (LINES[:1], "metrics.jsonl of seed 0 has the updates [1]"),
        ([LINES[0], *LINES], "metrics.jsonl of seed 0 has the updates [1, 1, 2]"),
        ([LINES[0], LINES[1] | {"x": 0.5}], "update 2 of seed 0 has another x"),
        ([LINES[0], LINES[1] | {"digest": "e"}], "update 2 of seed 0 has another digest"),
    ],
)
def test_a_run_that_differs_is_told(tmp_path, lines, said):
    make_run(tmp_path, lines)
    assert complaint(DONE, tmp_path, WHOLE) == said


def test_files_that_are_missing_broken_or_put_aside_are_told(tmp_path):
    assert complaint(DONE, tmp_path, WHOLE) == "0 of 1 runs"
    folder = make_run(tmp_path, LINES)
    (folder / "metrics.jsonl").write_text('{"update":\n')
    assert complaint(DONE, tmp_path, WHOLE).startswith("metrics.jsonl cannot be read")
    (folder / "checkpoints" / "damaged-0-000000000001").mkdir()
    assert complaint(DONE, tmp_path, WHOLE).startswith("a checkpoint was set aside: damaged-0")


def test_an_error_is_one_line():
    assert untold(Answer(1, "", "purerl: The disk is full.\n")) == ""
    assert untold(Answer(3, "", "purerl: Stopped after update 3 of 6.\nGo on with: ...\n")) == ""
    assert untold(Answer(1, "", "")).startswith("0 lines of error")
    assert untold(Answer(1, "", "purerl: One.\npurerl: Two.\n")).startswith("2 lines of error")
    assert untold(Answer(137, "", "purerl: One.\n")) == "exit code 137"
    assert untold(Answer(1, "", "purerl: One.\n", stuck="a thread")) == "it would hang at its end"


def test_where_a_command_went_on():
    assert began_at(Answer(0, "Resuming after update 1. Digest e\n", ""), WHOLE) == 1
    assert began_at(Answer(0, "Already done: 2 updates. Digest d\n", ""), WHOLE) == 2
    assert began_at(DONE, WHOLE) == 0


def test_complaints_of_one_kind_are_counted_together():
    one = kind_of("exit code 2: purerl: /a/b/config.json cannot be read: line 1")
    assert one == kind_of("exit code 2: purerl: /c/config.json cannot be read: line 22")
    assert one != kind_of("exit code 2: purerl: /a/b/manifest.json cannot be read: line 1")


def test_every_call_fails_with_every_error_and_a_sample_has_all_groups():
    calls = [["open", f"checkpoints/{n:012d}/a"] for n in range(8)] + [["mkdir", "b"]]
    cases = cases_of(SITUATIONS[0], calls)
    once = [case.fault for case in cases if case.fault.once]
    assert len(once) == 8 * len(ERRORS["open"]) + len(ERRORS["mkdir"])
    assert {fault.nth for fault in once if fault.kinds == ("open",)} == set(range(1, 9))
    groups = {case.group for case in cases}
    assert {case.group for case in choose(cases, 1, len(groups), 3)} == groups
    assert {case.group for case in choose(cases, 100, 0, 0)} == groups
    lasting = {case.group for case in cases if not case.fault.once}
    assert lasting and {case.group for case in choose(cases, 1, len(lasting), 3)} == lasting
    assert len(choose(cases, 1, 0, 0)) == len(cases) and set(ERRORS) == set(shim.KINDS)
