"""The control suite's scores: what counts, what is read back, what is ahead of whom."""

import argparse

import numpy as np
import pytest

from purerl.core.errors import INTERRUPTED, SUCCESS, USAGE, UserError
from purerl.envs.suite.tasks import TASKS
from purerl.experiments.benchmarks import (
    suite_benchmark,
    suite_clock,
    suite_pictures,
    suite_scores,
)
from purerl.experiments.benchmarks.suite_scores import Seed


def seed(number, *returns, task="cheetah-run", status="done"):
    steps = tuple(range(10, 10 * len(returns) + 1, 10))
    return Seed(task, number, status, steps, returns, tuple(s / 10 for s in steps))


SEEDS = [
    *(seed(i, 100.0 * i, 200.0 * i) for i in range(1, 6)),
    seed(1, 5.0, 30.0, task="hopper-hop"),
    seed(2, task="hopper-hop", status="failed"),
    seed(3, 900.0, task="hopper-hop", status="unfinished"),
]


def test_a_seed_that_failed_counts_and_one_that_is_unfinished_does_not():
    tasks = suite_scores.by_task(SEEDS)
    assert [s.seed for s in tasks["hopper-hop"]] == [1, 2]
    np.testing.assert_array_equal(suite_scores.strata(tasks)[1], [30.0, 0.0])
    head, cheetah, hopper = suite_scores.table(tasks, {"hopper-hop": {"brax_ppo_end": 2.0}})
    row = dict(zip(head, hopper, strict=True))
    assert (row["n"], row["failed"], row["lowest"], row["iqm"], row["low"]) == (2, 1, 0.0, 15.0, "")
    assert row["brax_ppo_end"] == 2.0 and row["reppo_end"] == ""
    row = dict(zip(head, cheetah, strict=True))
    assert (row["iqm"], row["lowest"], row["steps"], row["seconds"]) == (600.0, 200.0, 20, 2)
    assert row["low"] < 600 < row["high"]


def test_what_is_written_is_read_back(tmp_path):
    seeds = [*SEEDS, seed(9, 1.0)._replace(start=20.5, machine="a GPU")]
    suite_scores.write_seeds(tmp_path / "seeds.csv", seeds)
    assert sorted(suite_scores.read_seeds(tmp_path / "seeds.csv")) == sorted(seeds)


def test_files_of_earlier_versions_are_read(tmp_path):
    suite_scores.write_seeds(tmp_path / "seeds.csv", SEEDS)
    lines = (tmp_path / "seeds.csv").read_text().splitlines()
    old = "\n".join(",".join(line.split(",")[:6]) for line in lines)
    (tmp_path / "seeds.csv").write_text(old)
    assert sorted(suite_scores.read_seeds(tmp_path / "seeds.csv")) == sorted(SEEDS)


# --- by the clock ---


def timed(number, *points, start=30.0, status="done"):
    """A seed of points (second, return)."""
    seconds, returns = zip(*points, strict=True) if points else ((), ())
    steps = tuple(range(len(points)))
    return Seed("fish-swim", number, status, steps, returns, seconds, start, "a GPU")


TIMED = [
    timed(1, (100.0, 300.0), (126.0, 465.0), (127.0, 999.0), (700.0, 600.0), start=20.0),
    timed(2, (126.1, 500.0), (316.0, 700.0)),
    timed(3, status="failed", start=None),
]
THEIRS = {"fish-swim": {"x": [155.0, 566.0, None, 400.0], "y": [156.0, None, None, None]}}


def test_a_return_by_the_clock_is_the_newest_evaluations_by_then():
    head, row = suite_clock.table({"fish-swim": TIMED}, THEIRS)
    row = dict(zip(head, row, strict=True))
    # 465, 0, 0; then 999, 700, 0; then the same, and 600, 700, 0: of three the IQM is all's mean.
    assert [row[f"purerl_{t}"] for t in suite_clock.TIMES] == [155.0, 566.3, 566.3, 433.3]
    assert [row[f"lowest_{t}"] for t in suite_clock.TIMES] == [0.0] * 4
    assert (row["n"], row["machine"], row["start"]) == (3, "a GPU", 25.0)
    assert [row[f"x_{t}"] for t in suite_clock.TIMES] == [155.0, 566.0, "", 400.0]
    assert list(suite_clock.verdicts({"fish-swim": TIMED}, THEIRS)) == [
        "at or above x after 126 s: 1 of 1",
        "at or above x after 316 s: 1 of 1",
        "at or above x after 1200 s: 1 of 1",
        "at or above y after 126 s: 0 of 1; short: fish-swim",
    ]


def test_what_others_reached_by_then_is_of_tasks_that_there_are_and_never_of_the_future():
    published = suite_clock.references()
    assert set(published) <= set(TASKS) and suite_clock.names(published)[0] == "reppo"
    assert published["humanoid-run"]["reppo"] == [13, 235, 570, 760]
    assert published["cheetah-run"]["brax_sac"] == [729, 881, None, None]


def test_a_file_of_other_columns_is_named_with_what_it_lacks(tmp_path):
    path = tmp_path / "mine.csv"
    path.write_text("task,seed,score\ncheetah-run,1,900\n")
    with pytest.raises(UserError, match=r"mine.csv has no column status, steps, return, seconds;"):
        suite_benchmark.main(["--scores", str(path)])


def test_a_word_where_a_number_belongs_is_named_with_its_line(tmp_path):
    path = tmp_path / "mine.csv"
    suite_scores.write_seeds(path, [seed(1, 5.0)])
    path.write_text(path.read_text().replace(",5.00,", ",five,"))
    with pytest.raises(UserError, match=r"mine.csv, line 2: .*five"):
        suite_benchmark.main(["--scores", str(path)])


@pytest.mark.parametrize(
    "content", [b"\x89PNG\r\n", b"task,seed,status,steps,return,seconds\na,1,done,9\n"]
)
def test_a_file_that_is_no_table_or_ends_early_is_named(tmp_path, content):
    path = tmp_path / "mine.csv"
    path.write_bytes(content)
    with pytest.raises(
        UserError, match=r"mine.csv, line \d: .*; a file of scores is the seeds.csv"
    ):
        suite_benchmark.main(["--scores", str(path)])


@pytest.mark.parametrize("name", ["mistyped", "other"])
def test_a_place_without_a_run_is_named_and_nothing_is_written(tmp_path, name):
    """Beside other places, a table without its seeds would look whole."""
    (tmp_path / "other" / "run").mkdir(parents=True)
    out = tmp_path / "out"
    with pytest.raises(UserError, match=rf"{name}.*: give a seeds.csv, or a folder of runs"):
        suite_benchmark.main(["--scores", str(tmp_path / name), "--out", str(out)])
    assert not out.exists()


def test_of_a_seed_that_two_machines_have_the_longer_counts(tmp_path):
    short, long = seed(1, 5.0, status="unfinished"), seed(1, 5.0, 7.0)
    other = seed(2, 1.0)
    for name, seeds in (("a.csv", [long, other]), ("b.csv", [short])):
        suite_scores.write_seeds(tmp_path / name, seeds)
    for order in ("ab", "ba"):
        read = [suite_benchmark.scored(tmp_path / f"{name}.csv") for name in order]
        assert suite_scores.merged(read) == [long, other]


def test_a_seed_that_is_done_counts_beside_a_longer_one_that_is_not():
    done, longer = seed(1, 5.0), seed(1, 5.0, 7.0, status="unfinished")
    for order in ([done, longer], [longer, done]):
        assert suite_scores.merged([[one] for one in order]) == [done]


def test_runs_that_are_left_out_are_told(tmp_path, capsys):
    short, long = seed(1, 5.0, status="unfinished"), seed(1, 5.0, 7.0)
    for name, seeds in (("a.csv", [long, seed(2, 1.0)]), ("b.csv", [short])):
        suite_scores.write_seeds(tmp_path / name, seeds)
    places = [str(tmp_path / name) for name in ("a.csv", "b.csv")]
    suite_benchmark.main(["--scores", *places, "--out", str(tmp_path)])
    assert "another run of the task and seed is longer: 1" in capsys.readouterr().out
    suite_benchmark.main(["--scores", places[0], "--out", str(tmp_path)])
    assert "left out" not in capsys.readouterr().out


def test_a_wrong_word_is_told_in_one_line():
    with pytest.raises(UserError, match=r"^argument --seeds: invalid int value: 'two'\. All"):
        suite_benchmark.main(["--seeds", "two"])


def test_ahead_is_at_or_above():
    tasks = suite_scores.by_task(SEEDS)
    published = {"cheetah-run": {"x": 600.0, "y": 600.1}, "hopper-hop": {"x": 15.1}}
    assert suite_scores.ahead(tasks, published, "x") == (["cheetah-run"], ["hopper-hop"])
    assert suite_scores.ahead(tasks, published, "y") == ([], ["cheetah-run"])


@pytest.mark.parametrize(("score", "reached"), [(999.6, True), (999.4, False)])
def test_a_published_whole_number_is_reached_by_what_rounds_to_it(score, reached):
    tasks = suite_scores.by_task([seed(1, score)])
    above, _ = suite_scores.ahead(tasks, {"cheetah-run": {"x": 1000.0}}, "x")
    assert bool(above) == reached


def test_the_profile_weighs_tasks_equally():
    share, low, high = suite_scores.profile(suite_scores.by_task(SEEDS))
    at = {level: share[i] for i, level in enumerate(suite_scores.LEVELS)}
    assert at[0.0] == pytest.approx((1 + 0.5) / 2)
    assert at[500.0] == pytest.approx((3 / 5 + 0) / 2)
    assert at[1000.0] == 0.0
    assert (low <= share + 1e-9).all() and (share <= high + 1e-9).all()


def test_curves_are_where_all_seeds_were_evaluated(tmp_path):
    longer = [seed(1, 0.0, 10.0, 20.0), seed(2, 2.0, 30.0)]
    steps, band, seconds = suite_scores.common_curve(longer)
    assert steps == [10, 20]
    np.testing.assert_allclose(band.iqm, [1.0, 20.0])
    np.testing.assert_allclose(seconds, [1.0, 2.0])
    assert suite_scores.common_curve([seed(1, 1.0), seed(2)]) is None
    assert suite_pictures.together({"a": longer, "b": [seed(1, 7.0)]})[0] == [10]


def test_all_tasks_together_have_a_curve_though_evaluated_at_other_steps(tmp_path):
    """A humanoid of 50 M steps beside a cheetah of 10 M; what never began counts as 0."""
    cheetahs = [Seed("cheetah-run", 1, "done", (10, 20), (0.0, 100.0), (1.0, 2.0))]
    humanoids = [Seed("humanoid-run", 1, "done", (15, 45), (30.0, 90.0), (1.0, 2.0))]
    steps, band = suite_pictures.together({"a": cheetahs, "b": humanoids})
    assert steps == [15, 20]
    np.testing.assert_allclose(band.iqm, [(50 + 30) / 2, (100 + 40) / 2])
    never = [Seed("hopper-hop", 1, "failed", (), (), ())]
    _, band = suite_pictures.together({"a": cheetahs, "c": never})
    np.testing.assert_allclose(band.iqm, [0.0, 50.0])
    late = [Seed("hopper-hop", 1, "done", (30,), (1.0,), (1.0,))]
    assert suite_pictures.together({"a": cheetahs, "b": late}) is None
    suite_pictures.draw_together(tmp_path / "c.png", {"a": cheetahs, "b": late})
    assert (tmp_path / "c.png").stat().st_size > 0


def test_every_published_task_has_our_name():
    published = suite_scores.references()
    assert len(published) == 25
    assert published["cheetah-run"]["brax_ppo_end"] == 829
    assert "tdmpc2_4M" not in published["point_mass-easy"]  # an empty cell
    assert len(published.keys() & TASKS.keys()) >= 18


def test_a_seed_that_never_had_a_folder_counts_as_failed():
    asked = argparse.Namespace(tasks=["cheetah-run", "hopper-hop"], first_seed=1, seeds=3)
    missing = suite_benchmark.never_begun(asked, SEEDS)
    assert [(s.task, s.seed, s.status, s.score) for s in missing] == []
    missing = suite_benchmark.never_begun(asked, [s for s in SEEDS if s.seed != 2])
    assert [(s.task, s.seed, s.score) for s in missing] == [
        ("cheetah-run", 2, 0.0),
        ("hopper-hop", 2, 0.0),
    ]
    assert len(suite_scores.by_task(missing)["hopper-hop"]) == 1


@pytest.mark.parametrize(
    ("codes", "ends_with"),
    [([SUCCESS, INTERRUPTED], INTERRUPTED), ([INTERRUPTED], INTERRUPTED), ([USAGE], USAGE)],
)
def test_humanoids_are_a_sweep_of_their_own(codes, ends_with, monkeypatch, tmp_path):
    sweeps, left = [], list(codes)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(suite_benchmark, "sweep", lambda w: sweeps.append(w) or left.pop(0))
    asked = ["humanoid-walk", "cheetah-run", "humanoid-run", "--name", "mine"]
    assert suite_benchmark.main([*asked, "--ppo.gamma", "0.9"]) == ends_with
    begun = [(words[0], words[2], words[words.index("--name") + 1]) for words in sweeps]
    wanted = [
        ("suite_humanoid", "env.task=humanoid-walk,humanoid-run", "mine_humanoid"),
        ("suite", "env.task=cheetah-run", "mine"),
    ]
    assert begun == wanted[: len(codes)]
    assert all(words[-2:] == ["--ppo.gamma", "0.9"] for words in sweeps)


def test_for_a_gpu_all_but_the_humanoids_are_trained_with_its_settings(monkeypatch, tmp_path):
    sweeps = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(suite_benchmark, "sweep", lambda w: sweeps.append(w) or INTERRUPTED)
    suite_benchmark.main(["cheetah-run", "--gpu", "--name", "mine"])
    suite_benchmark.main(["humanoid-run", "--gpu", "--name", "mine"])
    begun = [(words[0], words[2], words[words.index("--name") + 1]) for words in sweeps]
    assert begun == [
        ("suite_gpu", "env.task=cheetah-run", "mine_gpu"),
        ("suite_humanoid", "env.task=humanoid-run", "mine_humanoid"),
    ]
    assert all("--gpu" not in words for words in sweeps)


@pytest.mark.slow
def test_pictures_are_drawn(tmp_path):
    tasks = suite_scores.by_task([s for s in SEEDS if s.task == "cheetah-run"])
    by_time = suite_clock.references()
    suite_pictures.draw_tasks(tmp_path / "a.png", tasks, suite_scores.references(), {}, "steps")
    suite_pictures.draw_tasks(tmp_path / "c.png", tasks, {}, by_time, "seconds")
    suite_pictures.draw_together(tmp_path / "b.png", tasks)
    assert all((tmp_path / f"{name}.png").stat().st_size > 5000 for name in "abc")


@pytest.mark.parametrize(("asked", "given"), [([], None), (["--steps", "8192"], "8192")])
def test_without_steps_each_experiment_keeps_its_own(asked, given, monkeypatch, tmp_path):
    sweeps = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(suite_benchmark, "sweep", lambda w: sweeps.append(w) or INTERRUPTED)
    suite_benchmark.main(["humanoid-walk", *asked])
    (words,) = sweeps
    steps = words[words.index("--ppo.num-steps") + 1] if "--ppo.num-steps" in words else None
    assert steps == given
