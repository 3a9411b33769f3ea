"""`python -m purerl.evaluate RUN` works from the run's folder alone."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from purerl import evaluate, run
from purerl.core.errors import USAGE
from purerl.runs import checkpoint_folder, loaded_run

# Bits are compared within one process, and between two that compile as a run does.
pytestmark = pytest.mark.usefixtures("file_is_compiled_quickly")

TOY = Path(__file__).parent.parent / "runs" / "toy_experiment.py"
ROOT = TOY.parent.parent.parent


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("evaluate")
    copy = place / "mine.py"
    copy.write_text(TOY.read_text())
    words = ["--runs", str(place / "runs"), "--env.steps", "3", "--network.policy-hidden", "5", "6"]
    assert run.main([str(copy), *words]) == 0
    copy.unlink()  # the run's own copy must do
    return place / "runs" / "mine" / "seed1"


def result(trained: Path, tmp_path: Path, *words: str) -> dict:
    file = tmp_path / "result.json"
    assert evaluate.main([str(trained), "--episodes", "6", "--json", str(file), *words]) == 0
    return json.loads(file.read_text())


def test_it_reports_every_metric_under_the_runs_own_settings(trained, tmp_path, capsys):
    found = result(trained, tmp_path)
    assert found["episodes"] == 6 and found["update"] == 12 and found["steps"] == 384
    assert found["metrics"]["episode_length"]["mean"] == 3.0  # the override, not the file's 4
    values = found["metrics"]["episode_return"]["values"]
    assert len(values) == 6
    assert found["metrics"]["episode_return"]["mean"] == pytest.approx(sum(values) / 6)
    said = capsys.readouterr().out
    assert "N = 6 episodes" in said and "reward_mean" in said and "std" in said


@pytest.mark.slow
def test_a_second_process_finds_its_program_compiled(trained, tmp_path):
    """The event is JAX's own, of a program that it has loaded from its cache."""
    watch = (
        "import sys, jax; from purerl import evaluate; hits = [];"
        "jax.monitoring.register_event_listener(lambda name, **_: hits.append(name));"
        "evaluate.main(sys.argv[1:]);"
        "print(hits.count('/jax/compilation_cache/cache_hits'))"
    )
    own = {"XDG_CACHE_HOME": str(tmp_path), "JAX_COMPILATION_CACHE_DIR": ""}
    command = [sys.executable, "-c", watch, str(trained), "--episodes", "3"]

    def start() -> list[str]:
        said = subprocess.check_output(command, text=True, env=os.environ | own, cwd=ROOT)
        return said.splitlines()

    first, second = start(), start()
    assert (tmp_path / "purerl" / "jax").is_dir()
    assert int(first[-1]) < int(second[-1])
    assert first[:-1] == second[:-1]


def test_equal_seeds_give_equal_episodes(trained, tmp_path):
    first = result(trained, tmp_path, "--stochastic")["metrics"]
    assert first == result(trained, tmp_path, "--stochastic")["metrics"]
    assert first != result(trained, tmp_path, "--stochastic", "--seed", "1")["metrics"]
    assert first != result(trained, tmp_path)["metrics"]


def test_a_checkpoint_can_be_chosen(trained, tmp_path, capsys):
    updates = checkpoint_folder.updates(trained / "checkpoints")
    assert result(trained, tmp_path, "--checkpoint", str(updates[0]))["update"] == updates[0]
    assert result(trained, tmp_path, "--checkpoint", "best")["update"] in updates
    assert evaluate.main([str(trained), "--checkpoint", "5000"]) == USAGE
    assert f"Valid: latest, best, {updates[0]}" in capsys.readouterr().err


@pytest.mark.slow
def test_a_policy_is_judged_on_an_engine_whose_states_have_other_leaves(tmp_path):
    # As a run of engine warp, which counts overflows, is on a laptop.
    text = TOY.read_text().replace("return Probe(", "return engine_probe(engine, ")
    text = text.replace("import Probe", "import Probe, engine_probe")
    file = tmp_path / "engines.py"
    file.write_text(text)
    assert run.main([str(file), "--runs", str(tmp_path), "--engine", "c"]) == 0
    trained = tmp_path / "engines" / "seed1"
    assert "c_count" in result(trained, tmp_path)["metrics"]
    elsewhere = result(trained, tmp_path, "--engine", "jax")
    assert "jax_count" in elsewhere["metrics"] and "c_count" not in elsewhere["metrics"]
    assert elsewhere["digest"] == result(trained, tmp_path)["digest"]


@pytest.mark.parametrize("words", [["/nowhere"], ["/nowhere", "--episods", "3"], []])
def test_a_mistake_is_one_line(words, capsys):
    assert evaluate.main(words) == USAGE
    said = capsys.readouterr().err
    assert len(said.strip().splitlines()) == 1 and "Traceback" not in said


def test_settings_that_do_not_fit_the_file_are_named(trained, tmp_path, capsys):
    copy = tmp_path / "run"
    shutil.copytree(trained, copy)
    settings = json.loads((copy / "config.json").read_text())
    settings["settings"]["env"]["gravity"] = 9.81
    (copy / "config.json").write_text(json.dumps(settings))
    assert evaluate.main([str(copy)]) == USAGE
    assert "env.gravity" in capsys.readouterr().err


def test_a_setting_and_code_that_came_after_the_run_are_told(tmp_path, capsys):
    file = tmp_path / "later.py"  # with its builders elsewhere
    file.write_text(
        "import dataclasses, functools\n"
        "from tests.runs.toy_experiment import build_env, experiment\n"
        "experiment = dataclasses.replace(experiment, build_env=functools.partial(build_env))\n"
    )
    assert run.main([str(file), "--runs", str(tmp_path)]) == 0
    trained = tmp_path / "later" / "seed1"
    result(trained, tmp_path)
    assert "any more" not in capsys.readouterr().out
    settings, facts = trained / "config.json", trained / "manifest.json"
    older = json.loads(settings.read_text())
    del older["settings"]["ppo"]["desired_kl"]
    settings.write_text(json.dumps(older))
    facts.write_text(json.dumps(json.loads(facts.read_text()) | {"source": {}}))
    assert result(trained, tmp_path)["update"] == 12
    said = capsys.readouterr().out
    assert "config.json lacks ppo.desired_kl; it is taken as 0.01." in said
    assert "is not that of the run any more" in said
    older["settings"]["ppo"]["segment_length"] = 4  # the code has it no more
    settings.write_text(json.dumps(older))
    assert evaluate.main([str(trained)]) == USAGE
    said = capsys.readouterr().err
    assert "no setting 'ppo.segment_length'" in said and "of another version" in said


def test_it_leaves_in_silence_when_its_reader_has(trained):
    command = [sys.executable, "-m", "purerl.evaluate", str(trained), "--episodes", "2"]
    ended = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    ended.stdout.close()  # as `| head` does
    assert ended.stderr.read() == b""
    assert ended.wait() == 128 + signal.SIGPIPE


def test_a_file_that_cannot_be_written_is_said_before_the_episodes(
    trained, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(loaded_run, "load", lambda *_: pytest.fail("the run was loaded"))
    assert evaluate.main([str(trained), "--json", str(tmp_path)]) == USAGE
    assert "cannot be written" in capsys.readouterr().err


def test_the_figures_are_shown_where_the_disk_is_full(trained, capsys):
    assert evaluate.main([str(trained), "--episodes", "2", "--json", "/dev/full"]) == USAGE
    shown = capsys.readouterr()
    assert "N = 2 episodes" in shown.out and "No space left" in shown.err
