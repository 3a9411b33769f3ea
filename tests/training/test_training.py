"""`purerl.train`: the folder, bits and lines of the command."""

import contextlib
import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Literal

import jax
import pytest
from hypothesis import given, settings, strategies as st

import purerl
from purerl import compare, evaluate, record, render, run
from purerl.core.errors import USAGE
from purerl.exact import xla_flags
from purerl.experiment.command_line import from_settings
from purerl.experiment.definition import Experiment
from purerl.experiment.loading import Source
from purerl.experiment.options import RunOptions
from purerl.experiment.settings_json import from_json, settings_of, to_json
from purerl.training import train
from tests.runs import toy_experiment

pytestmark = pytest.mark.usefixtures("file_is_compiled_quickly", "programs_are_kept")

TOY = Path(__file__).parent.parent / "runs" / "toy_experiment.py"
ROOT = TOY.parent.parent.parent
SETTINGS = {"seed": 3, "env.steps": 3, "network.policy_hidden": (5, 6), "ppo.learning_rate": 1e-3}
WORDS = [
    "--seed",
    "3",
    "--env.steps",
    "3",
    "--network.policy-hidden",
    "5",
    "6",
    "--ppo.learning-rate",
    "1e-3",
]


def told(said: str) -> tuple[list[str], dict[str, str]]:
    """Returns what a run printed, without its clock and its folder.

    Lines of progress, of which a clock decides how many there are, are apart: by their update.
    """
    lines = [line for line in said.splitlines() if not line.startswith(("Compiled", "run  "))]
    split = [re.split(r"  [\d,]+ steps/s ", line) for line in lines]
    progress = [parts[0] for parts in split if len(parts) > 1]
    return [parts[0] for parts in split if len(parts) == 1], {x.split()[1]: x for x in progress}


def written(folder: Path) -> dict:
    """Returns what a run's files say, without its id and its clock."""
    manifest = json.loads((folder / "manifest.json").read_text())
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return {
        "config": (folder / "config.json").read_text(),
        "manifest": {k: v for k, v in manifest.items() if k != "run_id"},
        "metrics": [{k: v for k, v in line.items() if k != "wall_s"} for line in lines],
        "experiment": (folder / "experiment.py").read_bytes(),
        "files": sorted(path.name for path in folder.iterdir()),
    }


@pytest.mark.slow
def test_it_makes_the_same_run_as_the_command(tmp_path):
    """Each in a process of its own, as users have it; in the one, JAX has begun before."""
    script = (
        "import sys, jax, purerl\n"
        "jax.numpy.ones(2).sum()\n"
        f"run = purerl.train(sys.argv[1], {SETTINGS}, runs=sys.argv[2], checkpoints=2)\n"
    )
    python = [sys.executable, "-c", script, str(TOY), str(tmp_path / "python")]
    words = [*WORDS, "--runs", str(tmp_path / "command"), "--checkpoints", "2"]
    command = [sys.executable, "-m", "purerl.run", str(TOY), *words]
    said = [subprocess.check_output(each, cwd=ROOT, text=True) for each in (python, command)]
    (lines, progress), (others, beside) = map(told, said)
    assert lines == others and "bit-exact    yes" in said[0]
    assert all(progress[update] == beside[update] for update in progress.keys() & beside.keys())
    folders = [tmp_path / by / "toy_experiment" / "seed3" for by in ("python", "command")]
    assert written(folders[0]) == written(folders[1])
    assert "digest" in written(folders[0])["metrics"][-1]


HEARD: list = []


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> purerl.Run:
    runs = tmp_path_factory.mktemp("train")
    return purerl.train(str(TOY), SETTINGS, runs=runs, on_metrics=HEARD.append)


def test_each_line_of_metrics_is_heard(trained):
    lines = (trained.folder / "metrics.jsonl").read_text().splitlines()
    written = [json.loads(line) for line in lines]
    assert [{k: v for k, v in line.items() if k != "digest"} for line in written] == HEARD


def test_an_error_of_who_hears_is_one_line_and_the_run_goes_on(trained, tmp_path):
    with pytest.raises(purerl.UserError, match="on_metrics: KeyError: 'retrun' .*line") as told:
        purerl.train(str(TOY), SETTINGS, runs=tmp_path, on_metrics=lambda line: line["retrun"])
    assert __file__ in str(told.value)
    run_ = purerl.train(str(TOY), SETTINGS, runs=tmp_path, resume=True)
    assert run_.digest == trained.digest


def test_it_returns_the_run(trained):
    assert isinstance(trained, purerl.Run) and trained.folder.name == "seed3"
    assert (trained.update, trained.steps) == (12, 384)
    assert trained.experiment.env.steps == 3 and trained.config.learning_rate == 1e-3
    assert trained.metrics()["digest"][-1] == trained.digest


def test_a_run_that_is_done_is_returned_at_once(trained, capsys):
    again = purerl.train(str(TOY), SETTINGS, runs=trained.folder.parent.parent, resume=True)
    assert again.digest == trained.digest
    assert "Already done" in capsys.readouterr().out


def test_a_run_that_was_stopped_goes_on(trained, tmp_path, monkeypatch):
    asked = iter([False, False, True])
    stop = lambda _: contextlib.nullcontext(lambda: next(asked, True))  # noqa: E731
    with monkeypatch.context() as patch:
        patch.setattr(train.signals, "stop_signals", stop)
        with pytest.raises(purerl.StoppedError, match="it is saved"):
            purerl.train(str(TOY), SETTINGS, runs=tmp_path)
    run_ = purerl.train(str(TOY), SETTINGS, runs=tmp_path, resume=True)
    assert run_.digest == trained.digest


@pytest.mark.slow
def test_debug_makes_an_experiment_tiny_and_leaves_no_run_here(tmp_path, monkeypatch):
    """2 s."""
    monkeypatch.chdir(tmp_path)
    few = purerl.train(str(TOY), {"ppo.num_envs": 4}, debug=True, seed=3)
    assert few.config.num_envs == 4 and few.config.rollout_length == 32  # what is given stays
    assert few.config.steps_per_update * few.config.num_updates == 1024
    assert few.metrics()["eval/episode_return"][-1] is not None  # the evaluation ran, too
    assert few.folder.name == "seed3" and not list(tmp_path.iterdir())
    again = purerl.train(str(TOY), {"ppo.num_envs": 4}, debug=True, seed=3)
    assert again.folder != few.folder and again.digest == few.digest
    with pytest.raises(purerl.UserError, match="A debug run is made anew: leave out --resume"):
        purerl.train(str(TOY), debug=True, resume=True)
    kept = purerl.train(str(TOY), debug=True, runs=tmp_path / "mine")
    assert kept.folder.is_relative_to(tmp_path / "mine")


def test_several_seeds_are_several_runs(trained, tmp_path):
    options = {"num_seeds": 2, "seeds_by": "map", "name": "many", "runs": tmp_path}
    first, second = purerl.train(str(TOY), SETTINGS, **options)
    assert (first.folder.name, second.folder.name) == ("many-seed3", "many-seed4")
    assert first.digest == trained.digest != second.digest


def test_who_gives_num_seeds_gets_a_list(tmp_path, monkeypatch):
    monkeypatch.setattr(train, "train_runs", lambda *_: [tmp_path])
    assert purerl.train(str(TOY)).folder == tmp_path
    assert [run_.folder for run_ in purerl.train(str(TOY), num_seeds=1)] == [tmp_path]


def test_it_trains_in_a_thread(trained, tmp_path):
    found = []

    def work():
        found.append(purerl.train(str(TOY), SETTINGS, runs=tmp_path))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found[0].digest == trained.digest


@pytest.mark.parametrize(
    ("changes", "options", "message"),
    [
        ({"ppo.num_step": 3}, {}, "no option --ppo.num-step. Did you mean --ppo.num-steps?"),
        ({"ppo": 3}, {}, "no option --ppo."),
        ({"ppo.num_steps": "many"}, {}, "num-steps is 'many'; it must be"),
        ({"ppo.gamma": 1.5}, {}, "gamma is 1.5; it must be in [0, 1]"),
        ({"ppo.schedule": "cubic"}, {}, "must be one of 'constant'"),
        ({"env.steps": None}, {}, "env.steps"),
        ({}, {"num_seed": 2}, "no option --num-seed. Did you mean --num-seeds?"),
        ({}, {"keep": 0}, "keep is 0; it must be at least 1"),
        ({}, {"cache": "perhaps"}, "cache"),
        ({}, {"resume": True}, "There is no run"),
    ],
)
def test_a_mistake_is_one_line_and_nothing_is_written(tmp_path, changes, options, message):
    with pytest.raises(purerl.UserError) as error:
        purerl.train(str(TOY), changes, runs=tmp_path, **options)
    assert message in str(error.value) and "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_a_group_is_resumed_with_its_number_of_seeds(tmp_path):
    (tmp_path / "toy_experiment" / "kk-seed2").mkdir(parents=True)
    with pytest.raises(purerl.UserError, match="no run .*/kk, but kk-seed2: give --num-seeds"):
        purerl.train(str(TOY), runs=tmp_path, name="kk", resume=True)


@dataclasses.dataclass(frozen=True)
class Inner:
    ratio: float = 0.5
    mode: Literal["a", "b"] = "a"


@dataclasses.dataclass(frozen=True)
class Kinds:
    """Settings of every kind."""

    flag: bool = True
    count: int = 1
    size: float = 1.0
    text: str = "x"
    widths: tuple[int, ...] = (3,)
    span: tuple[float, float] = (0.0, 1.0)
    limit: float | None = 2.0
    inner: Inner = Inner()


FLOATS = st.floats(allow_nan=False, width=64)
KINDS = st.builds(
    Kinds,
    st.booleans(),
    st.integers(-(10**12), 10**12),
    FLOATS,
    st.text("abc XYZ_./", min_size=1).filter(lambda text: text != "None"),
    st.lists(st.integers(), max_size=3).map(tuple),
    st.tuples(FLOATS, FLOATS),
    FLOATS | st.none(),
    st.builds(Inner, FLOATS, st.sampled_from("ab")),
)
BASE = dataclasses.replace(toy_experiment.experiment, env=Kinds())


def named(env: Kinds) -> dict:
    values = {f"env.{f.name}": getattr(env, f.name) for f in dataclasses.fields(Kinds)}
    inner = values.pop("env.inner")
    return values | {"env.inner.ratio": inner.ratio, "env.inner.mode": inner.mode}


@settings(deadline=None, max_examples=60)
@given(KINDS)
def test_settings_by_name_are_the_settings(env):
    chosen, options = from_settings(Source(BASE, "kinds", TOY), named(env), {"num_seeds": 2})
    assert chosen == dataclasses.replace(BASE, env=env) and options == RunOptions(num_seeds=2)
    assert isinstance(chosen.env.size, float)


@settings(deadline=None)
@given(KINDS)
def test_settings_survive_json(env):
    chosen = dataclasses.replace(BASE, env=env)
    assert from_json(BASE, json.loads(json.dumps(to_json(chosen)))) == chosen


def test_an_object_is_told_to_be_a_file_and_one_from_find_too(tmp_path):
    for mine in (toy_experiment.experiment, purerl.find(str(TOY))):
        with pytest.raises(purerl.UserError, match="put it into a .py file and give") as error:
            purerl.train(mine, SETTINGS, runs=tmp_path)
        assert "\n" not in str(error.value) and not list(tmp_path.iterdir())


def test_a_video_is_the_commands(tmp_path):
    with pytest.raises(purerl.UserError, match="purerl.render RUN"):
        purerl.train(str(TOY), SETTINGS, runs=tmp_path, video=True)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("flags", "said"), [("", True), ("--xla_gpu_autotune_level=0", False), ("--other", True)]
)
def test_flags_that_come_too_late_for_a_gpu_are_not_claimed(monkeypatch, capsys, flags, said):
    monkeypatch.setenv("XLA_FLAGS", flags)
    jax.devices()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    train.set_xla_flags_in_time()
    assert ("not bit-exact" in capsys.readouterr().out) == said
    assert (xla_flags.how_chosen("gpu") == "by timing") == said
    monkeypatch.undo()
    monkeypatch.setenv("XLA_FLAGS", "")
    train.set_xla_flags_in_time()
    assert xla_flags.how_chosen("gpu") == "fixed" and not capsys.readouterr().out


def test_a_second_signal_interrupts_and_the_handlers_come_back(capsys):
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), train.signals.stop_signals(train._raise) as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop()
        os.kill(os.getpid(), signal.SIGTERM)
    assert signal.getsignal(signal.SIGINT) is before


def test_a_run_from_before_the_move_is_one_line(trained, tmp_path, capsys):
    old = tmp_path / "old"
    subprocess.run(["cp", "-r", str(trained.folder), str(old)], check=True)
    text = (old / "experiment.py").read_text()
    older = text.replace("from purerl.ppo.config import", "from purerl.config import")
    assert older != text
    (old / "experiment.py").write_text(older)
    line = older[: older.index("purerl.config")].count("\n") + 1
    message = (
        f"purerl: {old}/experiment.py, line {line}: No module named 'purerl.config'; write "
        "`from purerl import Config`. The run was made by an older purerl: train it anew.\n"
    )
    for command in (evaluate, render, record):
        assert command.main([str(old), "--trust"]) == USAGE
        assert capsys.readouterr().err == message
    with pytest.raises(purerl.UserError, match="train it anew"):
        purerl.load(old, trust=True).state  # noqa: B018
    assert compare.main([str(old)]) == 0  # it reads what the run wrote, and nothing else
    assert len(purerl.load(old).metrics()["update"]) == 12
    capsys.readouterr()
    facts = json.loads((old / "manifest.json").read_text())
    facts["source"] = {f"purerl.old{i}": value for i, value in enumerate(facts["source"].values())}
    (old / "manifest.json").write_text(json.dumps(facts))
    words = [str(TOY), *WORDS, "--runs", str(tmp_path), "--resume"]
    (tmp_path / "toy_experiment").mkdir()
    old.rename(tmp_path / "toy_experiment" / "seed3")
    assert run.main(words) == USAGE
    said = capsys.readouterr().err
    assert "as of another version of purerl" in said and "train anew" in said
    assert len(said.splitlines()) <= 5, said


def test_types_of_settings_have_no_name_of_an_option():
    names = {field.name for field in dataclasses.fields(Experiment)}
    assert not names & {field.name for field in dataclasses.fields(RunOptions)}
    assert "seed" in settings_of(BASE)
