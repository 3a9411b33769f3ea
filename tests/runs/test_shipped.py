"""Policies that come with the library: found by name, played without a question, left untouched."""

import json
import os
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest

import purerl
from purerl import evaluate, view
from purerl.experiment import loading, trust
from purerl.experiments.benchmarks import policies
from purerl.machine import files
from purerl.report.video import videos_of
from purerl.runs import checkpoint_folder, restored_run
from purerl.runs.folder import read_run
from purerl.tune import subject
from tests.docs.blocks import ROOT

NAMES = sorted(place.name for place in loading.POLICIES.iterdir())
ONE = "cartpole_swingup"
PLACE = loading.POLICIES / ONE


@pytest.fixture
def elsewhere(tmp_path, monkeypatch) -> Path:
    """A folder of a user who has trained nothing."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path


def own_experiment(folder: Path) -> Path:
    (folder / "experiments").mkdir()
    text = (loading.OURS / f"{ONE}.py").read_text()
    file = folder / "experiments" / f"{ONE}.py"
    file.write_text(text.replace("64, 64", "8, 8"))
    return file


# --- playing ---


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow) if n.startswith("rodent") else n for n in NAMES],
)  # compiling a rodent's first state takes 20 s
def test_it_opens_in_silence_and_acts(name, elsewhere, capsys, monkeypatch):
    monkeypatch.setattr(restored_run, "_changed_since", lambda *_: ["The code"])
    run = purerl.load(name)
    action = run.policy(jax.jit(run.env.reset)(jax.random.key(0)).observation)
    assert action.shape == (run.env.action_size,) and np.isfinite(action).all()
    assert run.restored.setup.engine == "c"  # on a CPU, though some were trained on warp
    assert [x for x in run.metrics()["eval/episode_return"] if x is not None][-1] > 0.0
    assert capsys.readouterr() == ("", "") and not list(elsewhere.iterdir())


def test_evaluate_reaches_its_return_and_writes_nothing(elsewhere, capsys):
    before = files.hash_files(PLACE)
    assert evaluate.main([ONE, "--episodes", "1", "--json", "found.json"]) == 0
    (value,) = json.loads(Path("found.json").read_text())["metrics"]["episode_return"]["values"]
    assert value > 930.0
    assert files.hash_files(PLACE) == before and os.listdir(elsewhere) == ["found.json"]


def test_videos_go_to_the_users_folder(elsewhere):
    assert videos_of(PLACE) == videos_of(ROOT / "assets/policies" / ONE) == Path("videos", ONE)
    assert videos_of(elsewhere) == elsewhere / "videos"


def test_view_plays_it_and_plan_does_not(elsewhere):
    pytest.importorskip("trimesh")
    from purerl.tune.view import opening
    from purerl.tune.view.session import take_step

    found = subject.find([ONE], view.PROG, policies=True)
    words = ["--env.velocity-scale", "4.0"]
    chosen, options = subject.chosen(found, words, view.PROG, view.ViewOptions)
    session, source, title = opening.open_window(found, chosen, options)
    assert title == f"policies/{ONE}" and session.checkpoint.startswith("policy of update 244 ")
    assert take_step(session).length == 1
    assert source.words(session.numbers) == "--env.velocity-scale 4.0"
    assert source.command(session.numbers).startswith(f"python -m purerl.run {ONE} --env.")
    assert subject.find([ONE], "python -m purerl.plan").run is None
    for name in ("suite", f"purerl.experiments.{ONE}"):
        assert subject.find([name], view.PROG, policies=True).run is None


def test_what_is_the_users_own_goes_before(elsewhere):
    assert loading.shipped(ONE) == PLACE
    assert {loading.shipped(name) for name in ("", ".", "..", f"../{ONE}", "x" * 999)} == {None}
    file = own_experiment(elsewhere)
    assert loading.shipped(ONE) is None
    assert subject.find([ONE], view.PROG, policies=True).source.path == file
    file.unlink()
    Path(ONE).mkdir()
    assert loading.shipped(ONE) is None
    with pytest.raises(purerl.UserError, match="is no run"):
        purerl.load(ONE)


def test_its_code_is_known_whatever_experiment_the_user_has(elsewhere):
    own_experiment(elsewhere)
    assert purerl.load(PLACE).restored.experiment.network.policy_hidden == (64, 64)
    assert not (elsewhere / "state").exists()
    text = (PLACE / "experiment.py").read_bytes()
    assert trust.known_places(text, "none") and not trust.known_places(text + b"#", "none")


# --- the folders ---


@pytest.mark.parametrize("name", NAMES)
def test_it_says_nothing_of_the_machine(name):
    assert not list(policies.tells_of_machine(loading.POLICIES / name))


def test_what_it_says_of_a_machine_is_found(tmp_path):
    for i, text in enumerate(("home=/home/ann/x", '"/tmp/a/b.py"', "to /srv/x.", "/opt/a/")):
        (tmp_path / str(i)).write_text(text)
    (tmp_path / "fine").write_text("train/loss m/s, N/A a/b/c 3 / 4 //")
    told = list(policies.tells_of_machine(tmp_path))
    assert told == ["0: /home/ann/", "1: /tmp/a/", "2: /srv/", "3: /opt/a/"]


def test_all_of_them_are_small():
    sizes = [f.stat().st_size for f in loading.POLICIES.rglob("*") if f.is_file()]
    assert sum(sizes) <= 4_000_000  # 2.3 of them one that sees, remembers, and has another's policy


def test_a_run_becomes_such_a_folder(elsewhere, capsys):
    shutil.copytree(PLACE, "run")
    facts = json.loads(Path("run/manifest.json").read_text())
    assert facts["experiment_file"] == f"{ONE}.py"
    files.write_json(Path("run/manifest.json"), facts | {"experiment_file": f"/home/ann/{ONE}.py"})
    policies.ship(Path("run"), Path("made"))
    assert json.loads(Path("made/manifest.json").read_text()) == facts
    made, whole = purerl.load("made"), purerl.load(ONE)
    assert made.digest == whole.digest and made.metrics() == whole.metrics()
    jax.tree.map(np.testing.assert_array_equal, made.state.params, whole.state.params)
    with pytest.raises(purerl.UserError, match="is there"):
        policies.ship(Path("run"), Path("made"))


def test_metrics_are_thinned_to_the_last_line():
    lines = [{"update": i, "train/episode_return": 1.0, "train/loss": 2.0} for i in range(1, 481)]
    lines[4]["eval/episode_return"] = 3.0
    few = policies.thinned(lines)
    assert len(few) == policies.LINES + 1 and few[-1] == {
        "update": 480,
        "train/episode_return": 1.0,
    }
    assert few[0] == {"update": 5, "train/episode_return": 1.0, "eval/episode_return": 3.0}


# --- the page and the wheel ---


def test_the_page_has_them_with_their_digests():
    page = (ROOT / "docs/gallery.md").read_text()
    assert policies.table() in page
    for name in NAMES:
        folder = read_run(loading.POLICIES / name)
        path = checkpoint_folder.path_of(folder.checkpoints, *folder.updates)
        assert f"`{checkpoint_folder.load_meta(path)['digest']}`" in page
        assert f"`python -m purerl.view {name}`" in page


def test_a_wheel_has_them():
    pytest.importorskip("hatchling")
    from hatchling.builders.wheel import WheelBuilder

    found = {file.distribution_path for file in WheelBuilder(str(ROOT)).recurse_included_files()}
    kept = [file for file in (ROOT / "assets/policies").rglob("*") if file.is_file()]
    assert kept and {f"purerl/{file.relative_to(ROOT)}" for file in kept} <= found
