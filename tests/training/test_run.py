"""The run command: the same bits however it is interrupted, and one line for every mistake."""

import dataclasses
import errno
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from importlib import metadata
from pathlib import Path

import jax
import pytest

from purerl import run
from purerl.core import errors
from purerl.core.errors import FAILURE, INTERRUPTED, SUCCESS, USAGE
from purerl.devices import compilation, multi_device, programs
from purerl.devices.shards import Shards
from purerl.experiment import objects
from purerl.experiment.loading import find
from purerl.machine import command_errors, files, state_arrays
from purerl.ppo.config import Evaluation
from purerl.runs import (
    checkpoint,
    checkpoint_folder,
    folder as run_folder,
    loaded_run,
    manifest,
    resume,
)
from purerl.training import console, train, writer
from tests import quick

pytestmark = pytest.mark.usefixtures("programs_are_kept")

TOY = Path(__file__).parent.parent / "runs" / "toy_experiment.py"
ROOT = TOY.parent.parent.parent
LONG = ["--ppo.num-steps", "6400", "--checkpoints", "20"]  # 200 updates: seconds


def start(runs: Path, *words: str) -> int:
    return run.main([str(TOY), "--runs", str(runs), *words])


def folder(runs: Path, name: str = "seed1") -> Path:
    return runs / "toy_experiment" / name


def lines(runs: Path, name: str = "seed1") -> list[dict]:
    """Returns metrics.jsonl without the clock."""
    text = (folder(runs, name) / "metrics.jsonl").read_text()
    return [
        {k: v for k, v in json.loads(line).items() if k != "wall_s"} for line in text.splitlines()
    ]


def digest(runs: Path, name: str = "seed1") -> str:
    return lines(runs, name)[-1]["digest"]


def spawn(runs: Path, *words: str) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-m", "purerl.run", str(TOY), "--runs", str(runs), *words],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def wait_for(condition, process: subprocess.Popen, timeout: float = 60.0) -> None:
    end = time.monotonic() + timeout
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.005)


def checkpoints(runs: Path) -> list[int]:
    return checkpoint_folder.updates(folder(runs) / "checkpoints")


@pytest.fixture(scope="module")
def whole(programs_are_kept, tmp_path_factory) -> Path:
    """A run that nobody disturbed."""
    runs = tmp_path_factory.mktemp("whole")
    assert start(runs, "--checkpoints", "4") == SUCCESS
    return runs


def test_a_run_writes_what_it_should_and_no_more_steps_than_promised(whole):
    written = lines(whole)
    assert [line["update"] for line in written] == list(range(1, 13))
    assert written[-1]["steps"] == 384  # of 399: whole updates of 32 only
    assert [line["update"] for line in written if "digest" in line] == [3, 6, 9, 12]
    assert [line["update"] for line in written if "eval/episode_return" in line] == [6, 12]
    assert written[-1]["eval/episode_length"] == 4.0
    saved = checkpoint_folder.load_meta(folder(whole) / "checkpoints" / f"{12:012d}")
    assert saved["digest"] == digest(whole) and saved["steps"] == 384
    assert saved["metrics_bytes"] == (folder(whole) / "metrics.jsonl").stat().st_size
    assert (folder(whole) / "experiment.py").read_text() == TOY.read_text()
    facts = json.loads((folder(whole) / "manifest.json").read_text())
    assert facts["versions"]["jax"] and facts["device"]["platform"] and facts["engine"] != "auto"


def test_intervals_do_not_change_a_bit(whole, tmp_path):
    words = ["--log-every", "5", "--checkpoints", "1", "--evaluation.number", "0", "--tensorboard"]
    assert start(tmp_path, *words) == SUCCESS
    assert digest(tmp_path) == digest(whole)
    assert [line["update"] for line in lines(tmp_path)] == [5, 10, 12]


def test_another_seed_is_another_run(whole, tmp_path):
    assert start(tmp_path, "--seed", "2", "--name", "x") == SUCCESS
    assert digest(tmp_path, "x") != digest(whole)


@pytest.mark.parametrize("questions", [1, 2, 7, 14, 18])
def test_stopped_and_resumed_is_the_same_run(whole, tmp_path, stop_after, questions):
    stop_after(questions)
    assert start(tmp_path, "--checkpoints", "4") == INTERRUPTED
    assert len(lines(tmp_path)) < 12
    stop_after(10**9)
    assert start(tmp_path, "--checkpoints", "4", "--resume") == SUCCESS
    assert lines(tmp_path) == lines(whole)
    clocks = [
        json.loads(line)["wall_s"]
        for line in (folder(tmp_path) / "metrics.jsonl").read_text().splitlines()
    ]
    assert clocks == sorted(clocks) and clocks[0] > 0  # one clock through both lives


def test_a_stop_message_says_how_to_go_on(tmp_path, stop_after, capsys):
    stop_after(3)
    start(tmp_path)
    said = capsys.readouterr().err
    assert f"python -m purerl.run {TOY} --runs {tmp_path} --resume" in said
    assert "Traceback" not in said


def test_resuming_a_finished_run_only_says_so(whole, capsys):
    assert start(whole, "--checkpoints", "4", "--resume") == SUCCESS
    assert f"Already done: 12 updates. Digest {digest(whole)}" in capsys.readouterr().out


def test_a_damaged_checkpoint_is_told_and_the_run_is_still_the_same(
    whole, tmp_path, stop_after, capsys
):
    stop_after(14)
    start(tmp_path, "--checkpoints", "4")
    newest = folder(tmp_path) / "checkpoints" / f"{checkpoints(tmp_path)[-1]:012d}"
    file = newest / "meta.json"
    file.write_text(file.read_text()[:-20])
    stop_after(10**9)
    assert start(tmp_path, "--checkpoints", "4", "--resume") == SUCCESS
    assert lines(tmp_path) == lines(whole)
    assert "is damaged: meta.json is cut or overwritten" in capsys.readouterr().out


def test_a_run_without_a_whole_checkpoint_does_not_silently_begin_again(
    tmp_path, stop_after, capsys
):
    stop_after(14)
    start(tmp_path, "--checkpoints", "4")
    for update in checkpoints(tmp_path):
        file = folder(tmp_path) / "checkpoints" / f"{update:012d}" / "meta.json"
        file.write_text(file.read_text()[:-20])
    before = lines(tmp_path)
    stop_after(10**9)
    capsys.readouterr()
    for _ in range(2):
        said = refused(capsys, start(tmp_path, "--checkpoints", "4", "--resume"))
        assert "no whole checkpoint" in said and "damaged-0-" in said and "another --name" in said
    assert lines(tmp_path) == before


def test_a_run_killed_in_its_first_save_begins_as_it_did(whole, tmp_path, stop_after):
    stop_after(0)
    start(tmp_path, "--checkpoints", "4")
    assert checkpoints(tmp_path) == []
    (folder(tmp_path) / "checkpoints" / "000000000003.orbax-checkpoint-tmp").mkdir(parents=True)
    stop_after(10**9)
    assert start(tmp_path, "--checkpoints", "4", "--resume") == SUCCESS
    assert lines(tmp_path) == lines(whole)


def no_update(*_) -> compilation.Compiling:
    return compilation.Compiling(lambda: (None, {}), [], judged=None)


@pytest.mark.slow
@pytest.mark.parametrize("num_shards", [1, 2])
def test_a_beginning_has_the_same_bits_however_it_is_compiled(num_shards, monkeypatch):
    """Without the update, which takes longest to compile."""
    for module in (programs, multi_device):
        monkeypatch.setattr(module, "compile_update", no_update)
    chosen = find("cartpole_swingup")
    chosen = dataclasses.replace(chosen, engine="c", evaluation=Evaluation(number=0))
    setup = objects.build(chosen)
    digests = set()
    for fresh in (True, False):  # ahead of time, or when it is called
        compiled = programs.compile_programs(
            *setup[:3], chosen.evaluation, fresh, Shards(num_shards, 1), calls_host=True
        )
        state = state_arrays.flatten(compiled.init(jax.random.key(1)))
        digests.add(state_arrays.digest_leaves(state))
    assert len(digests) == 1


@pytest.mark.slow
def test_with_xla_on_one_thread_the_cores_do_not_matter(tmp_path):
    """MuJoCo's threads change no bits; the size of XLA's own pool does, for this ant."""
    words = ["ant_run", "--engine", "c", "--ppo.num-envs", "64", "--ppo.rollout-length", "32"]
    words += ["--ppo.num-steps", "4096", "--evaluation.number", "0", "--runs", str(tmp_path)]
    environment = {"NPROC": "1", "XLA_FLAGS": f"{os.environ['XLA_FLAGS']} {quick.FLAGS}"}
    own = sorted(os.sched_getaffinity(0))
    try:
        for number in {1, len(own)}:
            os.sched_setaffinity(0, own[:number])  # the child inherits it
            subprocess.run(
                [sys.executable, "-m", "purerl.run", *words, "--name", str(number)],
                cwd=ROOT, env=os.environ | environment, check=True, stdout=subprocess.DEVNULL,
            )  # fmt: skip
    finally:
        os.sched_setaffinity(0, own)
    last = [path.read_text().splitlines()[-1] for path in tmp_path.glob("*/*/metrics.jsonl")]
    assert len({json.loads(line)["digest"] for line in last}) == 1


@pytest.fixture(scope="module")
def undisturbed(programs_are_kept, tmp_path_factory) -> list[dict]:
    """The lines of a run that nothing stops."""
    place = tmp_path_factory.mktemp("undisturbed")
    assert start(place, *LONG) == SUCCESS
    return lines(place)


@pytest.mark.slow
def test_a_terminated_process_resumes_to_the_same_bits(undisturbed, tmp_path):
    """Killed ones do so in test_kill.py."""
    process = spawn(tmp_path, *LONG)
    wait_for(lambda: len(checkpoints(tmp_path)) >= 3, process)
    process.terminate()
    _, said = process.communicate(timeout=60)
    assert process.returncode == INTERRUPTED, said
    assert "--resume" in said and "Traceback" not in said
    assert checkpoints(tmp_path)[-1] < 200
    process = spawn(tmp_path, *LONG, "--resume")
    said, wrong = process.communicate(timeout=120)
    assert process.returncode == SUCCESS, wrong
    assert "Resuming after update" in said
    assert lines(tmp_path) == undisturbed
    assert digest(tmp_path) in said


def test_a_second_process_is_refused_with_the_first_ones_number(tmp_path):
    first = spawn(tmp_path, *LONG)
    try:
        wait_for((folder(tmp_path) / "config.json").exists, first)
        second = spawn(tmp_path, *LONG, "--resume")
        _, said = second.communicate(timeout=60)
        assert second.returncode == USAGE
        assert f"being written by process {first.pid}" in said and "Traceback" not in said
    finally:
        first.kill()
        first.communicate()


def test_a_full_disk_does_not_stop_training(whole, tmp_path, monkeypatch, capsys):
    save = checkpoint.save

    def sometimes(where, leaves, meta):
        if meta["update"] in (3, 6):
            raise OSError(28, "No space left on device")
        return save(where, leaves, meta)

    monkeypatch.setattr(writer.checkpoint, "save", sometimes)
    assert start(tmp_path, "--checkpoints", "4") == SUCCESS
    said = capsys.readouterr().out
    assert said.count("could not be saved") == 2 and "No space left" in said
    assert checkpoints(tmp_path) == [9, 12]
    assert lines(tmp_path) == lines(whole)


@pytest.fixture
def small_disk(tmp_path):
    """A file system with room for three checkpoints, and a function that makes it larger."""
    place = tmp_path / "small"
    place.mkdir()

    def mount(size: str) -> int:
        words = ["mount", "-t", "tmpfs", "-o", size, "tmpfs", str(place)]
        return subprocess.run(words, capture_output=True).returncode

    if not shutil.which("mount") or mount("size=300k"):
        pytest.skip("this machine lets nobody make a small file system")
    yield place, lambda: mount("remount,size=5m")
    subprocess.run(["umount", str(place)], check=True)


@pytest.mark.slow
def test_a_truly_full_disk_loses_nothing(whole, tmp_path, small_disk):
    runs, enlarge = small_disk
    words = ["--checkpoints", "12", "--keep", "12"]
    process = spawn(runs, *words, "--no-cache")
    said, wrong = process.communicate(timeout=120)
    assert process.returncode == FAILURE, wrong
    assert "could not be saved" in said and "Traceback" not in said + wrong
    last = checkpoints(runs)[-1]
    assert f"The newest on the disk is of update {last}. Mend that" in wrong and last < 12
    assert enlarge() == 0
    assert start(runs, *words, "--resume") == SUCCESS
    assert digest(runs) == digest(whole)
    without = [{k: v for k, v in line.items() if k != "digest"} for line in lines(runs)]
    assert without == [{k: v for k, v in line.items() if k != "digest"} for line in lines(whole)]


@pytest.mark.parametrize(
    "words",
    [
        "No space left on device",
        # tensorstore's words, which are XLA's for a full memory as well
        "RESOURCE_EXHAUSTED: Error writing local file: No space left on device",
    ],
)
def test_a_last_checkpoint_that_fails_is_an_error(tmp_path, monkeypatch, capsys, words):
    def never(where, leaves, meta):
        raise OSError(28, words)

    monkeypatch.setattr(writer.checkpoint, "save", never)
    assert start(tmp_path) == FAILURE
    said = capsys.readouterr().err
    assert "The last checkpoint could not be saved" in said and "memory" not in said


@pytest.mark.usefixtures("compiled_quickly")
@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "reason", "update"),
    [
        (["--ppo.reward-scale", "1e38"], "minibatches had a non-finite loss", 11),
        (
            ["--ppo.learning-rate", "1e38", "--ppo.schedule", "linear"],
            "Parameters are not finite",
            7,
        ),
    ],
)
@pytest.mark.parametrize("every", [1, 12])
def test_non_finite_learning_stops_and_is_never_saved(
    tmp_path, stop_after, capsys, words, reason, update, every
):
    stop_after(10)
    start(tmp_path, "--checkpoints", "4")
    assert checkpoints(tmp_path) == [3, 6]
    stop_after(10**9)
    words = [*words, "--log-every", str(every), "--checkpoints", "12", "--resume"]
    assert start(tmp_path, *words, "--allow-changes", "--keep", "9") == FAILURE
    said = capsys.readouterr().err
    # 2 minibatches in an update; with a chunk of 12 updates it is noticed at the end.
    update = update if every == 1 else 12
    assert f"Update {update} of {folder(tmp_path)}: " in said and reason in said, said
    sound = [3, 6, *(range(7, update) if every == 1 else ())]
    assert checkpoints(tmp_path) == sound
    assert f"The last good checkpoint is {folder(tmp_path)}" in said
    assert f"{sound[-1]:012d}" in said and "Traceback" not in said
    assert lines(tmp_path)[-1]["update"] == update


def test_a_failing_logger_does_not_stop_training(whole, tmp_path, monkeypatch, capsys):
    from purerl.training import loggers

    def fail(self, record):
        raise RuntimeError("the server is on fire")

    pytest.importorskip("tensorboardX")
    monkeypatch.setattr(loggers._TensorBoardSink, "log", fail)
    assert start(tmp_path, "--checkpoints", "4", "--tensorboard") == SUCCESS
    assert capsys.readouterr().out.count("TensorBoard logger is dropped") == 1
    assert lines(tmp_path) == lines(whole)


def refused(capsys, code: int) -> str:
    """Returns the message of a refused command, checked to be for a person."""
    said = capsys.readouterr().err
    assert code == USAGE, said
    assert "Traceback" not in said
    return said


def test_an_existing_run_is_not_overwritten(whole, capsys):
    before = (folder(whole) / "metrics.jsonl").read_bytes()
    assert "use --resume" in refused(capsys, start(whole))
    assert (folder(whole) / "metrics.jsonl").read_bytes() == before


def test_a_folder_that_is_no_run_is_not_written_to(tmp_path, capsys):
    folder(tmp_path).mkdir(parents=True)
    (folder(tmp_path) / "thesis.tex").write_text("")
    assert "thesis.tex" in refused(capsys, start(tmp_path))


@pytest.fixture
def unprivileged():
    """Makes this process one that file permissions hold for, and gives it a place to look at."""
    place = Path(tempfile.mkdtemp())
    place.chmod(0o755)
    root = os.geteuid() == 0
    try:
        yield lambda: os.seteuid(65534) if root else None, place
    finally:
        if root:
            os.seteuid(0)
        subprocess.run(["chmod", "-R", "u+w", place], check=True)
        shutil.rmtree(place)


def test_a_read_only_folder_is_told_and_unharmed(whole, unprivileged, capsys, monkeypatch):
    lose_privileges, place = unprivileged
    # The packages may be in a folder that only root reads.
    versions = {package: metadata.version(package) for package in manifest.PACKAGES}
    monkeypatch.setattr(manifest.metadata, "version", versions.__getitem__)
    shutil.copytree(whole / "toy_experiment", place / "toy_experiment")
    subprocess.run(["chmod", "-R", "a-w,a+rX", place], check=True)
    before = [f.read_bytes() for f in sorted(place.rglob("*")) if f.is_file()]
    lose_privileges()
    said = refused(capsys, start(place, "--resume"))
    assert f"{folder(place)}/.lock cannot be read or written: Permission denied" in said
    assert "cannot be read or written" in refused(capsys, start(place, "--name", "new"))
    assert [f.read_bytes() for f in sorted(place.rglob("*")) if f.is_file()] == before


@pytest.mark.usefixtures("compiled_quickly")
def test_a_run_begun_under_other_conditions_lists_them(tmp_path, stop_after, capsys):
    stop_after(9)
    start(tmp_path)
    file = folder(tmp_path) / "manifest.json"
    facts = json.loads(file.read_text())
    facts["versions"]["jax"] = "0.0.1"
    file.write_text(json.dumps(facts))
    capsys.readouterr()
    words = ["--resume", "--ppo.learning-rate", "3e-4"]
    said = refused(capsys, start(tmp_path, *words))
    assert "versions.jax: 0.0.1 -> " in said
    assert "settings.ppo.learning_rate: 0.001 -> 0.0003" in said
    stop_after(10**9)
    assert start(tmp_path, *words, "--allow-changes") == SUCCESS
    allowed = json.loads(file.read_text())["allowed_changes"]
    assert allowed[0]["after_update"] > 0
    edited = "fingerprint: config.json, manifest.json or experiment.py is not what the run wrote"
    assert len(allowed[0]["changes"]) == 3 and allowed[0]["changes"][-1] == edited
    assert json.loads(file.read_text())["run_id"] == facts["run_id"] and "of" not in allowed[0]


@pytest.mark.usefixtures("compiled_quickly")
@pytest.mark.parametrize("changed, counted", [("ppo.learning-rate=3e-4", 24), ("env.steps=6", 12)])
def test_a_copy_that_goes_on_otherwise_is_a_run_of_its_own(tmp_path, changed, counted):
    """Another reward begins a stage, so the returns before it do not count any more."""
    start(tmp_path)
    first = json.loads((folder(tmp_path) / "manifest.json").read_text())
    copy = folder(tmp_path).with_name("wide")
    shutil.copytree(folder(tmp_path), copy)
    words = ["--name", "wide", "--resume", "--allow-changes", f"--{changed}"]
    words += ["--ppo.num-steps", "799"]
    for _ in range(2):  # and stays it
        assert start(tmp_path, *words) == SUCCESS
        second = json.loads((copy / "manifest.json").read_text())
        assert second["run_id"] != first["run_id"] and second["name"] == "wide"
        (change,) = second["allowed_changes"]
        assert change["of"] == {"run_id": first["run_id"], "name": "seed1"}
    assert (
        loaded_run.load(copy).state.reward_normalizer.count.low == counted * 8 * 4
    )  # updates, of 24
    assert json.loads((folder(tmp_path) / "manifest.json").read_text()) == first


def test_a_run_that_is_done_is_not_given_settings_that_it_never_had(tmp_path, monkeypatch, capsys):
    start(tmp_path)
    before = [f.read_bytes() for f in sorted(folder(tmp_path).glob("*.json"))]
    words = ["--resume", "--allow-changes", "--ppo.learning-rate", "3e-4"]
    said = refused(capsys, start(tmp_path, *words))
    assert "has all of its updates" in said and "Raise --ppo.num-steps" in said
    assert "settings.ppo.learning_rate: 0.001 -> 0.0003" in said
    assert [f.read_bytes() for f in sorted(folder(tmp_path).glob("*.json"))] == before
    # What only surrounds it may have changed: its last checkpoint may be damaged, and it trains on.
    monkeypatch.setenv("NCCL_ALGO", "Ring")
    assert "NCCL_ALGO" in refused(capsys, start(tmp_path, "--resume"))
    assert start(tmp_path, "--resume", "--allow-changes") == SUCCESS
    config, manifest = sorted(folder(tmp_path).glob("*.json"))
    assert config.read_bytes() == before[0]
    assert "NCCL_ALGO" in str(json.loads(manifest.read_text())["allowed_changes"])


def test_changes_that_no_checkpoint_fits_leave_the_run_as_it_was(tmp_path, stop_after, capsys):
    stop_after(9)
    start(tmp_path)
    before = [f.read_bytes() for f in sorted(folder(tmp_path).glob("*.json"))]
    words = ["--resume", "--allow-changes", "--ppo.num-envs", "4", "--ppo.num-steps", "400"]
    assert "32 steps, and cannot go on with 16" in refused(capsys, start(tmp_path, *words))
    words += ["--ppo.rollout-length", "8"]
    assert "is of another state" in refused(capsys, start(tmp_path, *words))
    assert [f.read_bytes() for f in sorted(folder(tmp_path).glob("*.json"))] == before


def test_ctrl_c_before_anything_has_begun_is_no_traceback():
    def interrupted():
        raise KeyboardInterrupt

    with pytest.raises(SystemExit) as ended:
        command_errors.leave(interrupted)
    assert ended.value.code == 128 + signal.SIGINT


def test_a_thread_that_waits_for_ever_does_not_keep_the_process():
    code = """
import threading
from purerl.machine import command_errors
command_errors.LAST_SECONDS = 0.5
def command():
    threading.Thread(target=threading.Event().wait).start()
    return 1
command_errors.leave(command)
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, timeout=30)
    assert done.returncode == 1


def test_an_error_of_any_command_is_one_line_and_its_code(capsys):
    def mistaken():
        raise errors.UserError("Give a run.")

    with pytest.raises(SystemExit) as ended:
        command_errors.leave(mistaken)
    assert ended.value.code == USAGE and capsys.readouterr().err == "purerl: Give a run.\n"


@pytest.mark.parametrize(("left", "shown"), [(59.7, "0:01:00"), (3599.9, "1:00:00")])
def test_the_time_left_carries_over(left, shown):
    assert console.figures({"steps": 1}, left, 1.0).endswith(f"left {shown}")


def test_a_disk_that_is_full_at_the_start_is_one_line(tmp_path, monkeypatch, capsys):
    def full(path):
        if path.name == ".experiment.py.draft":
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files, "sync", full)
    assert "experiment.py cannot be written: No space" in refused(capsys, start(tmp_path))


def test_a_start_that_was_killed_half_way_can_be_made_again(tmp_path):
    (tmp_path / ".manifest.json.draft").touch()
    toy = [find(str(TOY))]
    resume.check_new_or_resume([run_folder.read(tmp_path)], toy, resume=False)
    (tmp_path / "notes.txt").touch()
    with pytest.raises(errors.UserError, match=r"no run \(it holds notes.txt\)"):
        resume.check_new_or_resume([run_folder.read(tmp_path)], toy, resume=False)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--resume"], "no run .* to resume"),
        (["--ppo.learing-rate", "1"], "Did you mean --ppo.learning-rate"),
        (["--ppo.learning-rate", "fast"], "is 'fast'; it must be a number"),
        (["--ppo.num-steps", "31"], "num_steps is 31, less than one update"),
        (["--ppo.num-minibatches", "3"], "does not divide"),
        (["--keep", "0"], "keep is 0"),
        (["--runs", "/dev/null/runs"], "cannot be read or written"),
    ],
)
def test_a_mistake_is_one_line(tmp_path, capsys, words, message):
    said = refused(capsys, start(tmp_path, *words))
    assert len(said.strip().splitlines()) == 1
    import re

    assert re.search(message, said), said
    assert not (tmp_path / "toy_experiment").exists()


def test_an_engine_that_is_not_installed_is_one_line(tmp_path, capsys, monkeypatch):
    found = importlib.util.find_spec
    absent = lambda name, *of: None if name == "warp" else found(name, *of)  # noqa: E731
    monkeypatch.setattr("importlib.util.find_spec", absent)
    said = refused(capsys, start(tmp_path, "--engine", "warp"))
    assert len(said.strip().splitlines()) == 1 and "warp" in said
    assert not (tmp_path / "toy_experiment").exists()


def test_an_unknown_experiment_is_one_line(capsys):
    said = refused(capsys, run.main(["no_such"]))
    assert len(said.strip().splitlines()) == 1


def test_help_needs_no_jax():
    code = (
        "import sys; from purerl import run; assert run.main(['--help']) == 0; "
        "assert 'jax' not in sys.modules and 'mujoco' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "--resume" in done.stdout and "Exit codes" in done.stdout


def test_the_second_signal_ends_at_once(monkeypatch, capsys):
    ended = []
    before = signal.getsignal(signal.SIGINT)  # not Python's own in a background job
    monkeypatch.setattr(os, "_exit", ended.append)
    with train.signals.stop_signals(os._exit) as stop:
        assert not stop()
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop() and not ended
        os.kill(os.getpid(), signal.SIGINT)
    assert ended == [128 + signal.SIGINT]
    assert signal.getsignal(signal.SIGINT) is before


def test_compiled_programs_are_where_the_user_keeps_caches(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert compilation.cache_folder() == tmp_path / "purerl" / "jax"
    for none in ("", "relative/path"):
        monkeypatch.setenv("XDG_CACHE_HOME", none)
        assert compilation.cache_folder() == Path.home() / ".cache" / "purerl" / "jax"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert compilation.cache_folder() == Path.home() / ".cache" / "purerl" / "jax"
