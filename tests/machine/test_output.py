"""Output that is lost ends no training; text from files commands no terminal."""

import io
import json
import os
import pty
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import purerl
from purerl import render, run
from purerl.core.errors import FAILURE, SUCCESS, USAGE, RunError, UserError
from purerl.machine import command_errors, output
from purerl.machine.files import write_answer
from tests import quick
from tests.training.test_run import ROOT, TOY, digest, folder, whole  # noqa: F401

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("programs_are_kept")]


def shell(line: str, *words: str) -> subprocess.CompletedProcess:
    """Runs a command of purerl; in `line`, "$@" is it with its `words`."""
    command = ["bash", "-o", "pipefail", "-c", line, "-", sys.executable, "-m", *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)


def train(place: Path, line: str, *words: str) -> subprocess.CompletedProcess:
    few = ["--checkpoints", "4", "--evaluation.number", "0"]  # which changes no bit
    return shell(line, "purerl.run", str(TOY), "--runs", str(place), *few, *words)


LOST = "purerl: Standard output cannot be written: {}. Training goes on without it.\n"
LINES = {  # what the shell does -> what standard error says of it
    '"$@" > /dev/full': LOST.format("No space left on device"),
    '"$@" | head -n 1': LOST.format("Broken pipe"),
    '"$@" >&-': "",
    '"$@" >&- 2>&-': "",
    '"$@" > /dev/full 2> /dev/full': "",
    '"$@" <&- >&- 2>&-': "",
}


@pytest.mark.slow
@pytest.mark.parametrize("line", LINES)
def test_training_goes_on_without_its_output(whole, tmp_path, line):  # noqa: F811
    done = train(tmp_path, line)
    assert (done.returncode, done.stderr) == (SUCCESS, LINES[line])
    assert digest(tmp_path) == digest(whole)
    assert json.loads((folder(tmp_path) / "config.json").read_text())


def test_a_full_disk_under_the_log_and_a_closed_error_are_no_faults(whole, tmp_path):  # noqa: F811
    done = train(tmp_path, '"$@" > /dev/full 2>&-')
    assert done.returncode == SUCCESS
    assert digest(tmp_path) == digest(whole)
    # Had nothing held their numbers, the next files would have got what C++ code prints.
    assert (folder(tmp_path) / ".lock").read_text().strip().isdigit()


@pytest.mark.slow
def test_a_bar_whose_terminal_goes_away_ends_no_training(whole, tmp_path):  # noqa: F811
    ours, theirs = pty.openpty()
    words = [sys.executable, "-m", "purerl.run", str(TOY), "--runs", str(tmp_path)]
    process = subprocess.Popen(
        [*words, "--ppo.num-steps", "64000"], cwd=ROOT, stdout=theirs, stderr=subprocess.PIPE,
        start_new_session=True, env=os.environ | {"TERM": "xterm", "XLA_FLAGS": quick.FLAGS},
    )  # fmt: skip
    os.close(theirs)
    shown = b""
    while b"\x1b[2K" not in shown:  # a line of the bar is drawn again
        shown += os.read(ours, 1000)
    os.close(ours)
    said = process.communicate(timeout=120)[1].decode()
    assert process.returncode == SUCCESS, said
    assert said == LOST.format("Input/output error")
    (last,) = (folder(tmp_path) / "checkpoints").glob("*2000")
    assert last.is_dir()


@pytest.mark.slow
@pytest.mark.parametrize("command", ["evaluate", "compare", "record"])
def test_an_answer_that_nobody_gets_is_a_failure(whole, tmp_path, command):  # noqa: F811
    def ask(line: str, out: str) -> tuple[int, str]:
        words = [f"purerl.{command}", str(folder(whole))]
        words += ["--out", str(tmp_path / out)] if command == "record" else []
        done = shell(line, *words)
        return done.returncode, done.stderr

    said = "purerl: Standard output cannot be written: No space left on device.\n"
    assert ask('"$@" > /dev/full', "full") == (FAILURE, said)
    assert ask('"$@" >&-', "closed") == (SUCCESS, "")


def test_so_is_a_list_that_nobody_gets():
    for words in (["purerl"], ["purerl.run", "--help"], ["purerl.compare", "--help"]):
        done = shell('"$@" > /dev/full', *words)
        assert done.returncode == FAILURE and done.stderr.count("\n") == 1, done.stderr
        done = shell('"$@" | true', *words)
        assert done.returncode in (SUCCESS, USAGE, 128 + signal.SIGPIPE) and not done.stderr


class Refusing(io.StringIO):
    """A stream that refuses some of its writes."""

    refuse = True

    def write(self, text: str) -> int:
        if self.refuse:
            raise OSError(28, "No space left on device")
        return super().write(text)


def test_a_line_is_printed_again_when_there_is_room_again(monkeypatch, capsys):
    output._tell_of_loss.cache_clear()
    stream = Refusing()
    monkeypatch.setattr(sys, "stdout", stream)
    output.say("lost")
    output.say("lost too")
    stream.refuse = False
    output.say("here")
    assert stream.getvalue() == "here\n"
    assert capsys.readouterr().err == LOST.format("No space left on device")
    stream.refuse = True
    with pytest.raises(RunError, match="cannot be written: No space left on device.$"):
        output.show("an answer")
    stream.close()
    output.say("to nobody")
    monkeypatch.setattr(sys, "stderr", stream)
    output.warn("to nobody")


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain, with ümlauts and 漢字", "plain, with ümlauts and 漢字"),
        ("\x1b[2J\x07\r\t\x9b1m", "\\x1b[2J\\x07\\r\\t\\x9b1m"),
        ("a\nb\u2028c", "a\\nb\\u2028c"),
        ("\u202eabc\u2066", "\\u202eabc\\u2066"),
        ("\udcff\ud800", "\\udcff\\ud800"),
    ],
)
def test_nothing_printed_commands_a_terminal(capsys, monkeypatch, text, shown):
    output.show(text)
    output.say(text)
    output.warn(text.replace("\n", ""))
    command_errors.tell(UserError(f"first\n{text}".replace("a\nb", "")))
    said = capsys.readouterr()
    assert said.out == f"{shown}\n{shown}\n"
    assert shown.replace("a\\nb", "").replace("\\n", "") in said.err
    assert all(line.isprintable() for line in (said.out + said.err).splitlines())
    ascii_only = io.TextIOWrapper(io.BytesIO(), "ascii")
    monkeypatch.setattr(sys, "stdout", ascii_only)
    output.say(text)
    assert ascii_only.buffer.getvalue().isascii()


def test_a_video_that_cannot_be_made_is_told_once(tmp_path, monkeypatch, capsys):
    def nothing_to_draw_with() -> str:
        raise RunError("There is no OpenGL to draw with.")

    monkeypatch.setattr(run, "choose_gl", nothing_to_draw_with)
    assert run.main([str(TOY), "--runs", str(tmp_path), "--video"]) == SUCCESS
    assert capsys.readouterr().err.count("There is no video: There is no OpenGL") == 1


def test_an_environment_that_cannot_be_drawn_is_told_by_its_public_name(tmp_path):
    assert run.main([str(TOY), "--runs", str(tmp_path), "--ppo.num-steps", "32"]) == SUCCESS
    trained = purerl.load(folder(tmp_path))
    with pytest.raises(UserError, match=r"no `physics` of the type purerl\.Physics\.$"):
        render.make(trained, trained.experiment, render.RenderOptions())
    assert isinstance(purerl.Physics, type)


def test_a_link_a_pipe_and_a_device_are_written_into_and_not_replaced(tmp_path):
    target, link, pipe = (tmp_path / name for name in ("target", "link", "pipe"))
    link.symlink_to(target)
    target.write_bytes(b"what was there before, and is longer")
    write_answer(link, b"told")
    assert link.is_symlink() and target.read_bytes() == b"told"
    os.mkfifo(pipe)
    with ThreadPoolExecutor(1) as pool:
        read = pool.submit(pipe.read_bytes)
        write_answer(pipe, b"told")
        assert read.result(10) == b"told" and pipe.is_fifo()
    full = tmp_path / "full"
    full.symlink_to("/dev/full")
    with pytest.raises(UserError, match="full cannot be written: No space left on device."):
        write_answer(full, b"told")
    assert full.is_symlink()
    plain = tmp_path / "plain"
    write_answer(plain, b"told")
    assert plain.read_bytes() == b"told" and len(list(tmp_path.iterdir())) == 5  # and no draft
