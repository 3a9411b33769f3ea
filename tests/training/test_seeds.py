"""Several seeds in one command: mapped they are single runs, vmapped they stay together."""

import json
import time
from pathlib import Path

import jax
import pytest

from purerl import run
from purerl.core.errors import FAILURE, INTERRUPTED, SUCCESS, USAGE, RunError, UserError
from purerl.devices import programs
from purerl.machine import state_arrays
from purerl.runs import checkpoint, checkpoint_folder
from purerl.training import console, loop, seeds, session, writer
from tests.training.test_run import ROOT, TOY, digest, folder, lines, start

# Bits are compared with those of runs that are compiled so too.
pytestmark = pytest.mark.usefixtures("file_is_compiled_quickly", "programs_are_kept")

CARTPOLE = ["--ppo.num-envs", "4", "--ppo.rollout-length", "8", "--ppo.num-steps", "128"]
CARTPOLE += ["--ppo.num-minibatches", "2", "--evaluation.number", "1"]
CARTPOLE += ["--evaluation.num-episodes", "2", "--ppo.episode-length", "20", "--engine", "c"]
THREE = ["--num-seeds", "3", "--checkpoints", "4"]
SEEDS = ("seed1", "seed2", "seed3")


@pytest.fixture(scope="module")
def vmapped(tmp_path_factory) -> Path:
    """Three vmapped seeds that nobody disturbed."""
    runs = tmp_path_factory.mktemp("vmapped")
    assert start(runs, *THREE) == SUCCESS
    return runs


def kept(runs: Path, seed: str) -> list[int]:
    return checkpoint_folder.updates(folder(runs, seed) / "checkpoints")


def test_a_mapped_seed_that_fails_is_told_before_the_next_one(tmp_path, monkeypatch, capsys):
    def fail(_job, group, _programs, _began):
        raise RunError("It diverged.") if group[0].number == 1 else UserError("Enough.")

    monkeypatch.setattr(seeds, "_train_together", fail)
    assert start(tmp_path, "--num-seeds", "2", "--seeds-by", "map") == USAGE
    assert capsys.readouterr().err.splitlines() == ["purerl: It diverged.", "purerl: Enough."]


def test_a_runs_clock_begins_with_its_command_or_with_the_seed_before_it(tmp_path, monkeypatch):
    prepare, ready = session.prepare, []

    def slowly(*arguments):
        time.sleep(1.0)
        ready.append(time.perf_counter())
        return prepare(*arguments)

    monkeypatch.setattr(session, "prepare", slowly)
    assert start(tmp_path, "--num-seeds", "2", "--seeds-by", "map") == SUCCESS
    after = time.perf_counter() - ready[0]
    files = [tmp_path / "toy_experiment" / f"seed{k}" / "metrics.jsonl" for k in (1, 2)]
    clocks = [[json.loads(line)["wall_s"] for line in file.open()] for file in files]
    assert clocks[0][0] >= 1.0 and clocks[1][-1] <= after
    assert clocks[0][-1] + clocks[1][-1] <= after + 1.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("experiment", "words"),
    [(str(TOY), []), (str(ROOT / "experiments" / "cartpole_swingup.py"), CARTPOLE)],
    ids=["toy", "cartpole"],
)
def test_mapped_seeds_are_single_runs_bit_for_bit(tmp_path, experiment, words):
    words = [experiment, "--runs", str(tmp_path), *words]
    assert run.main([*words, "--num-seeds", "2", "--seeds-by", "map", "--name", "many"]) == SUCCESS
    assert run.main([*words, "--seed", "2", "--name", "single"]) == SUCCESS
    name = Path(experiment).stem
    files = [tmp_path / name / run_name for run_name in ("many-seed2", "single", "many-seed1")]
    found = [[json.loads(x) for x in (f / "metrics.jsonl").open()] for f in files]
    many, single, other = [[line | {"wall_s": 0} for line in lines] for lines in found]
    assert many == single != other
    facts = [
        json.loads((f / "manifest.json").read_text()) | {"run_id": "", "name": ""} for f in files
    ]
    assert facts[0] == facts[1]
    assert (files[0] / "config.json").read_text() == (files[1] / "config.json").read_text()


@pytest.mark.slow
def test_a_mapped_seed_resumes_as_a_single_run(tmp_path, stop_after):
    words = [*THREE, "--seeds-by", "map"]
    stop_after(27)  # in the second seed
    assert start(tmp_path, *words) == INTERRUPTED
    assert lines(tmp_path, "seed1")[-1]["update"] == 12 > lines(tmp_path, "seed2")[-1]["update"]
    assert not (folder(tmp_path, "seed3") / "metrics.jsonl").exists()
    stop_after(10**9)
    assert start(tmp_path, "--checkpoints", "4", "--seed", "2", "--resume") == SUCCESS
    assert start(tmp_path, *words, "--resume") == SUCCESS
    assert start(tmp_path, "--checkpoints", "4", "--seed", "2", "--name", "undisturbed") == SUCCESS
    assert lines(tmp_path, "seed2") == lines(tmp_path, "undisturbed")
    assert lines(tmp_path, "seed3")[-1]["update"] == 12


@pytest.mark.slow
def test_vmapped_seeds_learn_as_single_runs_but_for_rounding(vmapped, tmp_path):
    assert start(tmp_path, "--seed", "2", "--checkpoints", "4") == SUCCESS
    many, single = lines(vmapped, "seed2"), lines(tmp_path, "seed2")
    assert [line.keys() for line in many] == [line.keys() for line in single]
    for ours, theirs in zip(many[:3], single[:3], strict=True):
        for name, value in theirs.items():
            if isinstance(value, float):
                assert ours[name] == pytest.approx(value, rel=1e-3, abs=1e-5), name
    assert len({digest(vmapped, seed) for seed in SEEDS}) == 3
    for seed in SEEDS:
        facts = json.loads((folder(vmapped, seed) / "manifest.json").read_text())
        assert facts["vmapped_seeds"] == {"first": 1, "number": 3}


def test_vmapped_seeds_are_the_same_each_time(vmapped, tmp_path):
    assert start(tmp_path, *THREE, "--log-every", "5", "--evaluation.number", "0") == SUCCESS
    for seed in SEEDS:
        assert digest(tmp_path, seed) == digest(vmapped, seed)


def test_each_vmapped_seed_is_a_run_that_others_can_read(vmapped):
    from purerl.runs.restored_run import restore

    for number, seed in enumerate(SEEDS, 1):
        found = restore(folder(vmapped, seed), "latest", print)
        assert found.experiment.seed == number
        assert found.saved.meta["digest"] == digest(vmapped, seed)


@pytest.mark.parametrize("questions", [1, 8, 15])
def test_vmapped_seeds_resume_exactly(vmapped, tmp_path, stop_after, questions):
    stop_after(questions)
    assert start(tmp_path, *THREE) == INTERRUPTED
    stop_after(10**9)
    assert start(tmp_path, *THREE, "--resume") == SUCCESS
    for seed in SEEDS:
        assert lines(tmp_path, seed) == lines(vmapped, seed)


def test_killed_between_two_seeds_saves_all_go_back_to_what_they_share(
    vmapped, tmp_path, stop_after, monkeypatch, capsys
):
    save = checkpoint.save

    def refuse(where, leaves, meta):
        if "seed3" in str(where) and meta["update"] in (6, 7):
            raise OSError(28, "No space left on device")
        return save(where, leaves, meta)

    monkeypatch.setattr(writer.checkpoint, "save", refuse)
    stop_after(11)  # while the last seed has not saved what the others have
    start(tmp_path, *THREE, "--keep", "1")
    assert kept(tmp_path, "seed1")[-1] > kept(tmp_path, "seed3")[-1] == 3
    assert 3 in kept(tmp_path, "seed1")  # kept for the others' sake
    monkeypatch.setattr(writer.checkpoint, "save", save)
    stop_after(10**9)
    assert start(tmp_path, *THREE, "--keep", "1", "--resume") == SUCCESS
    assert capsys.readouterr().out.count("Resuming after update 3") == 3
    for seed in SEEDS:
        assert lines(tmp_path, seed) == lines(vmapped, seed)
        assert kept(tmp_path, seed)[-1] == 12


def test_another_number_of_vmapped_seeds_is_refused(vmapped, capsys):
    assert start(vmapped, "--num-seeds", "2", "--checkpoints", "4", "--resume") == USAGE
    assert "vmapped_seeds.number: 3 -> 2" in capsys.readouterr().err
    assert start(vmapped, "--checkpoints", "4", "--resume") == USAGE


def test_a_lost_seed_is_named(tmp_path, stop_after, capsys):
    stop_after(10)
    start(tmp_path, *THREE)
    path = folder(tmp_path, "seed2") / "checkpoints" / f"{6:012d}"
    meta = checkpoint_folder.load_meta(path)
    from purerl.runs.restored_run import restore

    setup = restore(folder(tmp_path, "seed2"), "latest", print).setup
    state = checkpoint.load_checkpoint(path, programs.abstract_state(*setup[:3])).state
    state = state.replace(params=jax.tree.map(lambda x: x * 1e30, state.params))
    leaves = state_arrays.flatten(state)
    checkpoint.save(path.parent, leaves, meta | {"digest": state_arrays.digest_leaves(leaves)})
    stop_after(10**9)
    assert start(tmp_path, *THREE, "--resume") == FAILURE
    said = capsys.readouterr().err
    assert f"Update 7 of {folder(tmp_path, 'seed2')}: Parameters are not finite" in said
    assert f"{6:012d}" in said
    for seed in SEEDS:
        assert lines(tmp_path, seed)[-1]["update"] == 7 and kept(tmp_path, seed)[-1] == 6


def test_the_number_of_seeds_has_a_rule(tmp_path, capsys):
    assert start(tmp_path, "--num-seeds", "0") == USAGE
    assert "num_seeds is 0; it must be at least 1" in capsys.readouterr().err


def test_progress_of_seeds_shows_their_mean_return_and_all_that_was_lost():
    names = ("episode_return", "nonfinite_resets", "episodes", "episode_length")
    rows = [(1.0, 0.0, 2.0, 1.0), (None, 2.0, 0.0, None), (2.0, 5.0, 1.0, 9.0)]
    keys = [f"train/{name}" for name in names]
    records = [{"update": 3} | dict(zip(keys, row, strict=True)) for row in rows]
    assert list(loop.shown_record(records).values()) == [3, 1.5, 7.0, 3.0, 9.0]


def test_progress_says_where_to_look_when_every_episode_is_lost_or_one_step_long():
    record = {"steps": 1, "train/nonfinite_resets": 4.0, "train/episodes": 0.0}
    assert "purerl.check" in console.figures(record, 1.0, 1.0)
    assert "purerl.check" not in console.figures(record | {"train/episodes": 1.0}, 1.0, 1.0)
    short = {"steps": 1, "train/episode_length": 1.0}
    assert "look at terminated" in console.figures(short, 1.0, 1.0)
    assert "terminated" not in console.figures(short | {"train/episode_length": 1.5}, 1.0, 1.0)
