"""Experiments are found by name, path or module, and survive a round trip through JSON."""

import dataclasses
import json
from pathlib import Path

import pytest

from purerl.core.errors import UserError
from purerl.experiment import loading, settings_json
from purerl.runs import resume

TOY = Path(__file__).parent.parent / "runs" / "toy_experiment.py"


@pytest.fixture
def place(tmp_path, monkeypatch):
    (tmp_path / "experiments").mkdir()
    (tmp_path / "experiments" / "hopper.py").write_text(TOY.read_text())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_an_experiment_is_found_by_name_path_and_module(place):
    for name, expected in [
        ("hopper", "hopper"),
        ("experiments/hopper.py", "hopper"),
        ("tests.runs.toy_experiment", "toy_experiment"),
    ]:
        source = loading.find_source(name)
        assert source.name == expected and source.experiment.env.steps == 4
    (place / "experiments" / "plot.py").write_text('"""A script."""\n')
    found = loading.available()
    assert "hopper" in found and not {"plot", "benchmark"} & set(found)


def test_what_cannot_be_read_beside_the_experiments_harms_none(place):
    (place / "experiments" / ".#hopper.py").symlink_to("nobody@host.123")  # as Emacs locks a file
    (place / "experiments" / "gone.py").symlink_to("nowhere")
    (place / "experiments" / "latin.py").write_bytes(b"# caf\xe9\nexperiment = None\n")
    found = loading.available()
    assert "hopper" in found and "latin" in found and not {"gone", ".#hopper"} & set(found)
    assert loading.summary(found["latin"]) == ""


@pytest.mark.parametrize("name", ["hoper", "experiments/none.py", "tests.none_such", "no_such.x"])
def test_an_unknown_experiment_is_one_line(place, name):
    with pytest.raises(UserError) as error:
        loading.find_source(name)
    assert "\n" not in str(error.value)
    if name == "hoper":
        assert "Did you mean 'hopper'?" in str(error.value)


def test_a_mistake_in_the_file_names_its_line(tmp_path):
    for text, message in [
        ("x = 1\ny = 1 / 0\n", "line 2: ZeroDivisionError"),
        ("x = = 1\n", "line 1"),
        ("x = 1\n", "defines no `experiment"),
    ]:
        (tmp_path / "bad.py").write_text(text)
        with pytest.raises(UserError, match=message):
            loading.load_file(tmp_path / "bad.py")


def test_a_module_beside_the_file_is_found_with_the_path_that_the_error_names(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text("import rewards_beside\n")
    with pytest.raises(UserError) as error:
        loading.load_file(file)
    assert "PYTHONPATH" not in str(error.value)
    (tmp_path / "rewards_beside.py").write_text("UPRIGHT = 1\n")
    with pytest.raises(UserError, match=f"PYTHONPATH={tmp_path}$"):
        loading.load_file(file)


def test_settings_survive_json():
    chosen = loading.load_file(TOY).experiment
    network = dataclasses.replace(chosen.network, policy_hidden=(5, 6))
    changed = dataclasses.replace(chosen, seed=7, network=network)
    values = json.loads(json.dumps(settings_json.to_json(changed)))
    assert settings_json.from_json(chosen, values) == changed


@dataclasses.dataclass(frozen=True)
class Part:
    size: float = 1.0


@dataclasses.dataclass(frozen=True)
class Parts:
    several: tuple[Part, ...] = (Part(),)
    named: dict = dataclasses.field(default_factory=lambda: {"a": (1, 2)})
    one: Part | None = None


def test_dataclasses_in_tuples_and_tuples_in_dicts_survive_json():
    chosen = dataclasses.replace(loading.load_file(TOY).experiment, env=Parts())
    env = Parts(several=(Part(2.0), Part(3.0)), named={"a": (3, 4), "b": (5,)})
    changed = dataclasses.replace(chosen, env=env)
    values = json.loads(json.dumps(settings_json.to_json(changed)))
    assert settings_json.from_json(chosen, values) == changed


def test_a_setting_that_could_not_be_read_back_is_refused_before_training():
    source = loading.load_file(TOY)
    source = source._replace(experiment=dataclasses.replace(source.experiment, env=Parts()))
    resume.describe_config(source, source.experiment, {})
    chosen = dataclasses.replace(source.experiment, env=Parts(one=Part()))
    with pytest.raises(UserError, match="cannot hold env: .*one=Part"):
        resume.describe_config(source, chosen, {})


def test_a_mistake_in_a_module_names_its_line(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "mods").mkdir()
    for i, (text, message) in enumerate([
        ("x = 1\ny = 1 / 0\n", "line 2: ZeroDivisionError"),
        ("x = = 1\n", "line 1"),
        ("import no_such_thing\n", "line 1: .*no_such_thing"),
        ("from . import mod0\n", "imports relatively"),
    ]):  # fmt: skip
        (tmp_path / "mods" / f"mod{i}.py").write_text(text)
        if "imports" in message:
            (tmp_path / "mods" / "mod0.py").write_text("")
        with pytest.raises(UserError, match=message):
            loading.find_source(f"mods.mod{i}")


def test_missing_and_unknown_settings_are_named():
    chosen = loading.load_file(TOY).experiment
    values = settings_json.to_json(chosen)
    del values["env"]["steps"]
    with pytest.raises(UserError, match="lacks env.steps"):
        settings_json.from_json(chosen, values)
    values = settings_json.to_json(chosen)
    values["ppo"]["learning_rat"] = 1.0
    with pytest.raises(UserError, match="ppo.learning_rat'.*Did you mean 'ppo.learning_rate"):
        settings_json.from_json(chosen, values)


def test_a_setting_that_json_cannot_hold_is_named():
    chosen = loading.load_file(TOY).experiment
    env = dataclasses.replace(chosen.env, name=len)
    with pytest.raises(UserError, match=r"env.name is a builtin_function"):
        settings_json.to_json(dataclasses.replace(chosen, env=env))


def test_a_name_whose_file_is_here_is_told_the_file(tmp_path, monkeypatch):
    (tmp_path / "track.py").write_text("")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="as track.py"):
        loading.find_source("track")
