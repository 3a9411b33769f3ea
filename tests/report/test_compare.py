"""`python -m purerl.compare RUN RUN ...` on small made-up runs, and on two real ones."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import stats

from purerl import compare, run
from purerl.core.errors import FAILURE, USAGE
from purerl.report import comparison, run_reader

pytestmark = pytest.mark.usefixtures("file_is_compiled_quickly")

ROOT = Path(__file__).parent.parent.parent
TOY = ROOT / "tests" / "runs" / "toy_experiment.py"
PPO = {"num_steps": 400, "num_envs": 10, "rollout_length": 10, "num_minibatches": 1}
UPDATES = 4


def make_run(
    folder: Path,
    seed: int,
    values,
    rate: float = 1e-3,
    experiment: str = "walk",
    digests=(),
    more=None,
    **manifest,
) -> Path:
    """Writes a run of 100 steps an update, evaluated after each, that scored `values`."""
    folder.mkdir(parents=True)
    settings = {
        "env": {"speed": 1.0},
        "network": {"hidden": [8, 8]},
        "ppo": PPO | {"learning_rate": rate},
        "seed": seed,
        "engine": "auto",
        "evaluation": {"number": UPDATES},
    }
    config = {"experiment": experiment, "settings": settings, "schedule": {}}
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "manifest.json").write_text(json.dumps({"run_id": folder.name} | manifest))
    (folder / "experiment.py").write_text("")
    lines = []
    for i, value in enumerate(values):
        line = {"update": i + 1, "steps": 100 * (i + 1), "wall_s": seed, "train/loss": 0.5}
        line |= {"eval/episode_return": value}
        if i < len(digests):
            line["digest"] = digests[i]
        lines.append(line)
    if lines and more:
        lines[-1] |= more
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


def make_seeds(place: Path, name: str, finals, **about) -> None:
    for seed, final in enumerate(finals):
        ramp = [final * i / UPDATES for i in range(1, UPDATES + 1)]
        make_run(place / f"{name}{seed}", seed, ramp, **about)


def found(tmp_path: Path, *words, code: int = 0) -> dict:
    out = tmp_path / "out"
    assert compare.main([*map(str, words), "--out", str(out)]) == code
    return json.loads((out / "compare.json").read_text())


def only_line(capsys) -> str:
    said = capsys.readouterr().err.strip()
    assert len(said.splitlines()) == 1 and "Traceback" not in said
    return said


# --- over seeds ---


def test_ten_seeds_of_this_against_ten_of_that(tmp_path, capsys):
    generator = np.random.default_rng(0)
    this, that = generator.normal(10, 1, 10), generator.normal(11, 1, 10)
    make_seeds(tmp_path / "runs", "this", this)
    make_seeds(tmp_path / "runs", "that", that, rate=3e-3)
    result = found(tmp_path, tmp_path / "runs" / "this*", tmp_path / "runs" / "that*")
    assert result["settings_that_differ"] == {"ppo.learning_rate": [0.001, 0.003]}
    first, second = result["groups"]
    assert first["label"] == "ppo.learning_rate=0.001" and first["n"] == second["n"] == 10
    assert first["iqm"] == pytest.approx(stats.trim_mean(this, 0.25))
    assert first["interval"]["low"] < first["iqm"] < first["interval"]["high"]
    assert second["worst"] == pytest.approx(that.min())
    assert second["worst_run"].endswith(f"that{that.argmin()}")
    assert first["tenth"] == pytest.approx(np.percentile(this, 10))
    (against,) = result["versus_first"]
    better = stats.mannwhitneyu(that, this).statistic / 100
    assert against["label"] == second["label"] and against["baseline"] == first["label"]
    assert against["improvement"] == pytest.approx(better)
    assert against["difference"] == pytest.approx(second["iqm"] - first["iqm"])
    assert against["improvement_interval"]["low"] < better
    said = capsys.readouterr().out
    assert "differs: ppo.learning_rate is 0.001 | 0.003" in said
    assert f"{first['iqm']:.4g}" in said and "P(better)" in said


def test_the_same_seeds_are_compared_in_pairs(tmp_path, capsys):
    """Seeds that decide more than the setting: the interval of pairs sees the setting."""
    this = np.array([10.0, 20.0, 30.0, 40.0, 50.0, 60.0])
    gain = np.array([1.0, 2.0, 3.0, 2.0, 1.0, 3.0])
    make_seeds(tmp_path / "runs", "this", this)
    # In another order of folders, one seed without a partner, one that did not end.
    for seed in (5, 3, 1, 0, 2, 4):
        make_run(tmp_path / "runs" / f"that{9 - seed}", seed, [(this + gain)[seed]] * 4, rate=1.0)
    make_run(tmp_path / "runs" / "that_alone", 77, [1000.0] * 4, rate=1.0)
    make_run(tmp_path / "runs" / "this_ends_early", 77, [0.0], rate=1e-3)
    words = [tmp_path / "runs" / "this*", tmp_path / "runs" / "that*"]
    (against,) = found(tmp_path, *words)["versus_first"]
    assert against["baseline"] == "ppo.learning_rate=0.001" and against["same_seeds"] == 6
    assert against["paired_difference"] == pytest.approx(2.0)  # of 1, 1, 2, 2, 3, 3
    assert 1.0 <= against["paired_interval"]["low"] < 2.0 < against["paired_interval"]["high"] <= 3
    assert against["difference_interval"]["low"] < 0
    assert "Paired: differences" in capsys.readouterr().out


def test_other_seeds_have_no_pairs(tmp_path, capsys):
    make_seeds(tmp_path / "runs", "this", [1.0, 2.0])
    make_run(tmp_path / "runs" / "that", 9, [5.0] * 4, rate=1.0)
    (against,) = found(tmp_path, tmp_path / "runs")["versus_first"]
    assert (against["same_seeds"], against["paired_difference"]) == (0, None)
    assert "Paired" not in capsys.readouterr().out


def test_curves_are_written_as_numbers_and_as_a_picture(tmp_path):
    make_seeds(tmp_path / "runs", "a", [4.0, 8.0, 12.0, 16.0, 40.0])
    found(tmp_path, tmp_path / "runs")
    with (tmp_path / "out" / "curves.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["steps"]) for row in rows] == [100, 200, 300, 400]
    assert [float(row["iqm"]) for row in rows] == [3.0, 6.0, 9.0, 12.0]  # of 8, 12 and 16
    assert float(rows[3]["low"]) == pytest.approx(4 * float(rows[0]["low"]))
    assert float(rows[0]["low"]) < 3.0 < float(rows[0]["high"])
    with Image.open(tmp_path / "out" / "curves.png") as picture:
        assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 20
    with (tmp_path / "out" / "groups.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert row["label"] == "walk" and float(row["iqm"]) == 12.0 and row["n"] == "5"


def test_a_run_that_failed_early_does_not_end_the_others_curve(tmp_path):
    make_seeds(tmp_path / "runs", "a", [4.0, 8.0, 12.0, 16.0])
    make_run(tmp_path / "runs" / "b", 9, [3.0, None], more={"train/reward": None})  # after 200
    found(tmp_path, tmp_path / "runs")
    with (tmp_path / "out" / "curves.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["steps"]) for row in rows] == [100, 200, 300, 400]
    assert [float(row["iqm"]) for row in rows] == [
        pytest.approx(sum(sorted([x, 2 * x, 3 * x, 4 * x, 3.0])[1:-1]) / 3)
        for x in (1.0, 2.0, 3.0, 4.0)
    ]


def test_below_five_seeds_there_is_no_interval_and_it_says_so(tmp_path, capsys):
    make_seeds(tmp_path / "runs", "a", [1.0, 2.0, 3.0, 4.0])
    make_seeds(tmp_path / "runs", "b", [1.0, 2.0, 3.0, 4.0, 5.0], rate=1.0)
    result = found(tmp_path, tmp_path / "runs")
    assert result["groups"][0]["interval"] is None and result["groups"][1]["interval"]
    assert result["versus_first"][0]["difference_interval"] is None
    assert "No interval (-) below 5 seeds" in capsys.readouterr().out


def test_the_picture_says_which_intervals_it_has_and_what_thin_lines_are(tmp_path, monkeypatch):
    pyplot = comparison.plotter()
    make_seeds(tmp_path / "runs", "few", [1.0, 2.0, 3.0])
    make_seeds(tmp_path / "runs", "many", [1.0, 2.0, 3.0, 4.0, 5.0], rate=1.0)
    titles = []
    with monkeypatch.context() as patch:
        patch.setattr(pyplot, "close", lambda figure: None)
        for names in ("few*", "many*", "*"):
            found(tmp_path, tmp_path / "runs" / names)
            (axes,) = pyplot.gcf().axes
            legend = [text.get_text() for text in axes.get_legend().get_texts()]
            titles.append(axes.get_title())
            assert len(axes.collections) == (names != "few*") and legend[-1] == "each run"
    pyplot.close("all")
    title = "Interquartile mean (mean below 4 seeds), 95% intervals from 5 on"
    assert titles == [title] * 3


@pytest.mark.parametrize("n, iqm, tenth", [(3, None, None), (4, 2.5, None), (10, 5.5, 1.9)])
def test_a_statistic_has_its_name_from_the_number_of_seeds_on_at_which_it_is_one(
    tmp_path, capsys, n, iqm, tenth
):
    make_seeds(tmp_path / "runs", "a", np.arange(1.0, n + 1))
    (group,) = found(tmp_path, tmp_path / "runs")["groups"]
    assert (group["iqm"], group["score"]) == (iqm, np.mean(range(1, n + 1)))
    assert group["tenth"] == (tenth and pytest.approx(tenth))
    assert ("Below 4 seeds there is no IQM" in capsys.readouterr().out) == (iqm is None)


# --- code ---


def test_runs_of_other_code_are_groups_of_their_own_and_what_differs_is_named(tmp_path, capsys):
    runs = tmp_path / "runs"
    for name, code, final in (("old", "11", 1.0), ("new", "22", 9.0)):
        about = {"source": {"mine": code, "envs": "0"}, "model": "m", "arrays": {"float32[2]": "a"}}
        make_seeds(runs, name, [final] * 4, **about)
    result = found(tmp_path, runs)
    assert [(g["n"], g["iqm"]) for g in result["groups"]] == [(4, 9.0), (4, 1.0)]
    assert result["settings_that_differ"].keys() == {"code"}
    (against,) = result["versus_first"]  # of equal seeds
    assert (against["same_seeds"], against["difference"]) == (4, -8.0)
    assert "other conditions: source.mine: 22 -> 11" in capsys.readouterr().out


@pytest.mark.parametrize("what", [{"model": "n"}, {"arrays": {"float32[2]": "b"}}])
def test_another_model_and_other_data_are_other_code(tmp_path, what):
    about = {"source": {"mine": "1"}, "model": "m", "arrays": {"float32[2]": "a"}}
    make_run(tmp_path / "runs" / "a", 1, [1.0] * 4, **about)
    make_run(tmp_path / "runs" / "b", 2, [1.0] * 4, **(about | what))
    assert [g["n"] for g in found(tmp_path, tmp_path / "runs")["groups"]] == [1, 1]


def test_code_tells_no_experiments_apart_that_settings_tell_apart(tmp_path):
    make_seeds(tmp_path / "runs", "a", [1.0] * 2, source={"mine": "1"})
    make_seeds(tmp_path / "runs", "b", [1.0] * 2, source={"mine": "2"}, rate=1.0)
    labels = [group["label"] for group in found(tmp_path, tmp_path / "runs")["groups"]]
    assert labels == ["ppo.learning_rate=0.001", "ppo.learning_rate=1.0"]


def test_a_run_of_the_name_comes_before_runs_of_the_pattern(tmp_path):
    make_run(tmp_path / "lr1", 1, [1.0] * 4)
    make_run(tmp_path / "lr[1]", 1, [2.0] * 4)
    assert run_reader.find_runs([tmp_path / "lr[1]"]) == [tmp_path / "lr[1]"]
    assert run_reader.find_runs([tmp_path / "lr[12]"]) == [tmp_path / "lr1"]


# --- how runs ended ---


def test_failed_runs_count_and_unfinished_ones_do_not(tmp_path, capsys):
    runs = tmp_path / "runs"
    make_seeds(runs, "a", [10.0, 11.0, 12.0])
    make_run(runs / "exploded", 7, [2.0, None], more={"train/skipped_in_a_row": 10.0})
    make_run(runs / "no_step_was_sound", 9, [3.0, None], more={"train/reward": None})
    make_run(runs / "killed", 8, [1.0, 1.0])
    (group,) = found(tmp_path, runs)["groups"]
    assert (group["n"], group["done"], group["failed"], group["unfinished"]) == (5, 3, 2, 1)
    assert group["worst"] == 2.0 and group["worst_run"].endswith("exploded")
    said = capsys.readouterr().out
    assert "1 unfinished runs are left out." in said and "Failed runs" in said


def test_an_older_run_with_a_setting_that_is_gone_is_unfinished_too(tmp_path):
    folder = make_run(tmp_path / "one", 1, [1.0, 2.0])
    config = json.loads((folder / "config.json").read_text())
    config["settings"]["ppo"]["segment_length"] = 4
    (folder / "config.json").write_text(json.dumps(config))
    assert run_reader.read(folder).status == "unfinished"


def test_groups_can_be_chosen_and_what_is_left_aside_makes_strata(tmp_path):
    runs = tmp_path / "runs"
    for name, experiment, rate, finals in [
        ("a", "walk", 1e-3, [1.0, 2.0]),
        ("b", "hop", 1e-3, [100.0, 200.0]),
        ("c", "walk", 3e-3, [3.0, 4.0]),
        ("d", "hop", 3e-3, [20.0, 150.0]),
    ]:
        make_seeds(runs, name, finals, rate=rate, experiment=experiment)
    assert len(found(tmp_path, runs)["groups"]) == 4
    result = found(tmp_path, runs, "--group-by", "ppo.learning-rate")
    labels = [group["label"] for group in result["groups"]]
    assert labels == ["ppo.learning_rate=0.001", "ppo.learning_rate=0.003"]
    # Better in all pairs of walk and in 1 of 4 of hop; of all 16 pairs it would be 9.
    assert result["versus_first"][0]["improvement"] == 0.625
    # Each task with itself: 2, 2, -80, -50.
    assert result["versus_first"][0]["same_seeds"] == 4
    assert result["versus_first"][0]["paired_difference"] == -24.0
    labels = [g["label"] for g in found(tmp_path, runs, "--group-by", "experiment")["groups"]]
    assert labels == ["walk", "hop"]


# --- the same run twice ---


def test_long_names_of_groups_and_many_files_leave_the_table_readable(tmp_path, capsys):
    sources = [{f"module_{i}": f"{name}{i}" for i in range(9)} for name in "ab"]
    for name, source in zip("ab", sources, strict=True):
        experiment = f"{name}_{'walks_and_trots_and_runs_' * 3}"
        make_run(tmp_path / name, 1, [1.0] * UPDATES, experiment=experiment, source=source)
    found(tmp_path, tmp_path / "a", tmp_path / "b")
    said = capsys.readouterr().out.splitlines()
    assert "other conditions: source: 9 files" in said
    assert not [line for line in said if "module_" in line]
    assert [line for line in said if line.startswith("group 2 is b_walks_and_trots")]
    (head,) = (i for i, line in enumerate(said) if line.startswith("group  n"))
    assert [line.split()[0] for line in said[head + 1 : head + 3]] == ["1", "2"]
    assert max(map(len, said[head : head + 3])) < 100
    assert "against 1:" in said


def test_equal_digests_are_the_same_run_and_count_once(tmp_path, capsys):
    make_run(tmp_path / "runs" / "a", 1, [1.0] * 4, digests=["d1", "d2", "d3", "d4"])
    make_run(tmp_path / "runs" / "b", 1, [1.0] * 4, digests=["d1", "d2", "d3", "d4"])
    result = found(tmp_path, tmp_path / "runs")
    (pair,) = result["pairs"]
    assert pair["same"] and pair["promised"] and pair["last_equal"] == 4
    assert result["groups"][0]["n"] == 1
    assert "same: 4 digests, the last d4 of update 4" in capsys.readouterr().out


def went_on(*changes: str) -> dict:
    return {"allowed_changes": [{"after_update": 2, "changes": list(changes)}]}


def test_a_run_that_went_on_with_other_settings_is_another_one(tmp_path, capsys):
    """It has the settings of the other in the end, and was not trained with them from the start."""
    make_run(tmp_path / "runs" / "direct", 1, [1.0] * 4, digests=["d1", "d2"])
    changed = went_on("settings.ppo.num_steps: 200 -> 400")
    make_run(tmp_path / "runs" / "longer", 1, [3.0] * 4, digests=["d1", "e2"], **changed)
    result = found(tmp_path, tmp_path / "runs", code=0)
    assert result["pairs"] == [] and [group["n"] for group in result["groups"]] == [1, 1]
    said = "settings.ppo.num_steps: 200 -> 400 after update 2"
    assert result["settings_that_differ"] == {"went_on_with": [None, said]}
    assert said in capsys.readouterr().out


def test_a_run_that_went_on_under_other_conditions_promises_no_bits(tmp_path, capsys):
    changes = ("versions.jax: 1 -> 2", "source.purerl.ppo.losses: a -> b")
    changes += ("settings.evaluation.number: 10 -> 20",)
    make_run(tmp_path / "runs" / "a", 1, [1.0] * 4, digests=["d1"])
    make_run(tmp_path / "runs" / "b", 1, [1.0] * 4, digests=["e1"], **went_on(*changes))
    result = found(tmp_path, tmp_path / "runs", code=0)
    assert not result["pairs"][0]["promised"] and result["groups"][0]["n"] == 1
    assert "runs/b went on after a change" in capsys.readouterr().out


def test_other_seeds_are_not_twins(tmp_path):
    make_run(tmp_path / "runs" / "a", 1, [1.0] * 4, digests=["d1"])
    make_run(tmp_path / "runs" / "b", 2, [1.0] * 4, digests=["e1"])
    assert found(tmp_path, tmp_path / "runs")["pairs"] == []


def test_where_two_runs_part_by_their_metrics(tmp_path, capsys):
    make_run(tmp_path / "runs" / "a", 1, [1.0, 2.0, 3.0, 4.0], digests=["d1", "d2", "d3"])
    make_run(tmp_path / "runs" / "b", 1, [1.0, 2.0, 3.5, 4.5], digests=["d1", "d2", "e3"])
    (pair,) = found(tmp_path, tmp_path / "runs", code=FAILURE)["pairs"]
    assert (pair["same"], pair["last_equal"], pair["parted"]) == (False, 2, 3)
    said = capsys.readouterr().out
    assert "the same at update 2, not at update 3" in said
    assert "metrics part at update 3: eval/episode_return is 3.0 and 3.5" in said


def test_under_other_conditions_a_difference_is_no_fault(tmp_path, capsys):
    make_run(tmp_path / "runs" / "a", 1, [1.0] * 4, digests=["d1"], engine="c")
    make_run(tmp_path / "runs" / "b", 1, [1.0] * 4, digests=["e1"], engine="jax")
    (pair,) = found(tmp_path, tmp_path / "runs", code=0)["pairs"]
    assert pair["same"] is False and not pair["promised"]
    assert "other conditions: engine: c -> jax" in capsys.readouterr().out


def test_bits_are_compared_without_a_score(tmp_path, capsys):
    for name, digest in (("a", "d1"), ("b", "e1")):
        make_run(tmp_path / "runs" / name, 1, [1.0, 2.0], digests=[digest])
    result = found(tmp_path, tmp_path / "runs", "--metric", "eval/none", code=FAILURE)
    assert result["pairs"][0]["same"] is False and result["groups"] == []
    said = capsys.readouterr().out
    assert "not at update 1" in said and "No scores: " in said and "eval/none" in said


def test_runs_that_promise_no_bits_may_differ(tmp_path):
    for name, digest in (("a", "d1"), ("b", "e1")):
        make_run(tmp_path / "runs" / name, 1, [1.0] * 4, digests=[digest], bit_exact=False)
    (pair,) = found(tmp_path, tmp_path / "runs", code=0)["pairs"]
    assert pair["same"] is False and not pair["promised"]


@pytest.mark.slow
def test_real_runs_part_at_a_named_leaf(tmp_path, capsys):
    runs = tmp_path / "runs"
    for name, seed in (("one", "1"), ("two", "2")):
        assert run.main([str(TOY), "--runs", str(runs), "--name", name, "--seed", seed]) == 0
    folder = runs / "toy_experiment"
    settings = json.loads((folder / "two" / "config.json").read_text())
    settings["settings"]["seed"] = 1  # so that it should be the same run, and is not
    (folder / "two" / "config.json").write_text(json.dumps(settings))
    (pair,) = found(tmp_path, folder / "one", folder / "two", code=FAILURE)["pairs"]
    assert pair["parted"] == 2 and pair["last_equal"] is None
    assert any(leaf.startswith("key|") for leaf in pair["leaves"])
    assert "update" not in pair["leaves"] and pair["leaves"] == sorted(pair["leaves"])
    said = capsys.readouterr().out
    # Update 2 has no checkpoint any more: the oldest that both keep shows the leaves.
    assert f"leaves differ in the checkpoint of update 10: {pair['leaves'][0]}" in said


def test_runs_are_compared_without_jax(tmp_path):
    """A laptop that only looks at runs, and a shell that only asks for --help, wait for no JAX."""
    make_seeds(tmp_path / "runs", "a", [1.0, 2.0], digests=["d1"])
    make_run(tmp_path / "runs" / "again", 0, [1.0] * 4, digests=["e1"])  # the leaves are looked at
    heavy = "('jax', 'jaxlib', 'flax', 'mujoco')"
    code = (
        "import sys; from purerl import compare; code = compare.main(sys.argv[1:]); "
        f"assert not set({heavy}) & set(sys.modules); sys.exit(code)"
    )
    words = [sys.executable, "-c", code, str(tmp_path / "runs"), "--out", str(tmp_path / "out")]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (FAILURE, "")
    assert "not at update 1" in done.stdout and (tmp_path / "out" / "curves.png").exists()


# --- mistakes ---


def test_a_mistake_is_one_line(tmp_path, capsys):
    make_seeds(tmp_path / "runs", "a", [1.0, 2.0])
    runs = str(tmp_path / "runs")
    for words, part in [
        ([], "Give the runs"),
        ([str(tmp_path / "nowhere")], "no run"),
        ([str(tmp_path / "none*")], "no run"),
        ([runs, "--metric", "eval/episode_retrun"], "Did you mean 'eval/episode_return'?"),
        ([runs, "--group-by", "ppo.lerning_rate"], "Did you mean 'ppo.learning_rate'?"),
        ([runs, "--metrik", "x"], "--metric"),
    ]:
        assert compare.main(words) == USAGE, words
        assert part in only_line(capsys)


def test_broken_files_are_named(tmp_path, capsys):
    folder = make_run(tmp_path / "a", 1, [1.0])
    (folder / "manifest.json").write_text("{")
    assert compare.main([str(folder)]) == USAGE
    assert "manifest.json" in only_line(capsys)
    for broken in ("{}", "[3]", '[{"after_update": "x"}]', '[{"after_update": 1, "changes": 3}]'):
        (folder / "manifest.json").write_text(f'{{"allowed_changes": {broken}}}')
        assert compare.main([str(folder)]) == USAGE
        assert "manifest.json" in only_line(capsys)
    (folder / "manifest.json").write_text("{}")
    (folder / "config.json").write_text('{"experiment": "x"}')
    assert compare.main([str(folder)]) == USAGE
    assert "config.json" in only_line(capsys)


def test_half_a_line_at_the_end_is_a_run_being_written(tmp_path):
    folder = make_run(tmp_path / "a", 1, [1.0] * 4)
    with (folder / "metrics.jsonl").open("a") as file:
        file.write('{"update": 5, "st')
    assert found(tmp_path, folder)["groups"][0]["n"] == 1


def test_no_finished_run_is_said(tmp_path, capsys):
    folder = make_run(tmp_path / "a", 1, [1.0])
    assert compare.main([str(folder)]) == USAGE
    assert "No run that is done" in only_line(capsys)
