"""`python -m purerl.sweep`: its command line and file, checked before anything is started."""

import shlex
from pathlib import Path

import pytest

import purerl
from purerl import UserError, run, sweep
from purerl.core.errors import SUCCESS, USAGE
from purerl.experiment.command_line import from_command_line
from purerl.experiment.loading import find_source
from purerl.tune.sweep import slurm
from tests.training.test_run import TOY

FILE = f"""
experiment = "{TOY}"
name = "widths"
seeds = 2
grid.ppo.learning-rate = [1e-3, 1e-4]
grid.network.policy_hidden = [[8, 8], [16]]
[settings]
ppo.gamma = 0.9
cache = false
"""


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def dry(capsys, *words: str) -> list[list[str]]:
    """Returns the commands of a dry run, without `python -m purerl.run`."""
    assert sweep.main([*words, "--dry-run"]) == SUCCESS
    lines = capsys.readouterr().out.splitlines()
    assert all(line.startswith("python -m purerl.run ") for line in lines)
    return [shlex.split(line)[3:] for line in lines]


def test_a_point_is_a_command_that_run_takes(capsys, place):
    words = ["--grid", "ppo.learning-rate=1e-3,1e-4", "network.policy-hidden=8 8,16", "--ppo.gamma"]
    commands = dry(capsys, str(TOY), *words, "0.9", "--seeds", "2", "--no-cache")
    assert len(commands) == 4 and list(place.iterdir()) == []
    source = find_source(commands[0][0])
    chosen, options = from_command_line(source, commands[2][1:], "run")
    assert (chosen.ppo.learning_rate, chosen.ppo.gamma) == (1e-4, 0.9)
    assert chosen.network.policy_hidden == (8, 8)
    assert (options.name, options.num_seeds, options.cache) == ("p0002", 2, False)
    assert str(options.runs) == "sweeps/toy_experiment"


def test_a_file_says_the_same(capsys, place):
    (place / "sweep.toml").write_text(FILE)
    words = ["--grid", "ppo.learning-rate=0.001,0.0001", "--grid", "network.policy-hidden=8 8,16"]
    words += ["--seeds", "2", "--name", "widths", "--ppo.gamma", "0.9", "--no-cache"]
    assert dry(capsys, "sweep.toml") == dry(capsys, str(TOY), *words)
    # The command line wins.
    assert dry(capsys, "sweep.toml", "--name", "other")[0][-3] == "p0000"
    assert "sweeps/other" in dry(capsys, "sweep.toml", "--name", "other")[0]


def test_an_entry_of_a_dict_is_a_setting(capsys, place):
    coded = TOY.with_name("coded_experiment.py")
    commands = dry(capsys, str(coded), "--grid", "ppo.auxiliary.sparsity=0.1,0 0.1 99")
    assert [words[1 : words.index("--runs")] for words in commands] == [
        ["--ppo.auxiliary.sparsity", "0.1"], ["--ppo.auxiliary.sparsity", "0", "0.1", "99"]
    ]  # fmt: skip
    assert sweep.main([str(coded), "--grid", "ppo.auxiliary.kl=1"]) == USAGE
    assert "There is no setting 'ppo.auxiliary.kl'" in capsys.readouterr().err


MISTAKES = [
    (["--grid", "ppo.lr=1,2"], "There is no setting 'ppo.lr'. Did you mean ppo.learning-rate?"),
    (["--grid", "ppo.learning-rate=1e-3,fast"], "--ppo.learning-rate is 'fast'; it must be a num"),
    (["--grid", "ppo.num-epochs=1,1.5"], "--ppo.num-epochs is '1.5'; it must be a whole number"),
    (["--grid", "ppo.schedule=constant,linnear"], "linnear"),
    (["--grid", "ppo.gamma=0.9,2"], "The point ppo.gamma=2: "),
    (["--grid", "ppo.gamma="], "ppo.gamma has no value"),
    (["--grid", "ppo.gamma"], "'ppo.gamma' names no values"),
    (["--grid"], "names no values"),
    ([], "Nothing is swept"),
    (["--grid", "ppo.gamma=0.9,0.90"], "ppo.gamma has the value 0.90 twice"),
    (["--grid", "ppo.gamma=0.9", "--grid", "ppo.gamma=0.8"], "ppo.gamma is given twice"),
    (["--grid", "ppo.gamma=0.9", "--ppo.gamma=0.8"], "ppo.gamma is given twice"),
    (["--grid", "seed=1,2"], "give --seeds 3"),
    (["--gird", "ppo.gamma=0.9"], "no option --gird. Did you mean --grid?"),
    (["--grid", "ppo.gamma=0.9", "--ppo.gama", "1"], "--ppo.gama. Did you mean --ppo.gamma?"),
    (["--grid", "ppo.num-envs=1..10001"], "10,001 points, of at most 10,000"),
    (["--grid", "ppo.gamma=0.9", "--num-seeds", "2"], "is no option of a sweep's runs; give"),
    (["--grid", "ppo.gamma=0.9", "--seeds", "0"], "seeds is 0; it must be at least 1"),
    (["--grid", "ppo.gamma=0.9", "--random", "3"], "--grid and --random are two sweeps"),
    (["--over", "ppo.gamma=0.9"], "say how many points: --random 20"),
    (["--random", "3"], "--random draws nothing"),
    (["--optuna", "3", "--over", "ppo.gamma=0.9..1", "--slurm", "a=1"], "leave one of them out"),
    (
        ["--grid", "evaluation.number=0,3"],
        "evaluation.number is 0, and a point without an evaluation has no eval/episode_return",
    ),
    (["--grid", "ppo.gamma=0.9", "--evaluation.number", "0"], "has no eval/episode_return; give"),
    (["--optuna", "3", "--over", "evaluation.number=0..3"], "has no eval/episode_return; give"),
    (
        ["--grid", "ppo.gamma=0.9", "--num-shards", "2"],
        "num_shards is 2, and 3 vmapped seeds share one program on one device; use --seeds-by map",
    ),
    (["--grid", "ppo.gamma=0.9", "--name", "a/b"], "name is 'a/b'; it must be the name of one"),
]


@pytest.mark.parametrize(("words", "said"), MISTAKES, ids=[" ".join(m[0]) for m in MISTAKES])
def test_a_mistake_is_one_line_and_starts_nothing(words, said, capsys, place):
    assert sweep.main([str(TOY), *words]) == USAGE
    told = capsys.readouterr()
    (line,) = told.err.strip().splitlines()
    assert line.startswith("purerl: ") and said in line
    assert told.out == "" and list(place.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("experiment = 3", "names no experiment"),
        ("experiment = ", "is no TOML"),
        ('experiment = "x"\nsedes = 3', "There is no key 'sedes'. Did you mean 'seeds'?"),
        ('experiment = "x"\ngrid = 3', "grid is 3; it must be a table, [grid]"),
        ('experiment = "x"\n[grid]\na = [2020-01-01]', "it must be a number, a text or a list"),
        ('experiment = "x"\n[grid]\na = ["b,c", "d"]', "a has the value 'b,c', and a comma parts"),
        (
            f'experiment = "{TOY}"\n[grid]\nppo.gamma = [0.9]\n[settings]\nname = "hello"',
            "--name is no option of a sweep's runs; it names the sweep: in a file it stands above",
        ),
    ],
)
def test_a_file_with_a_mistake_is_one_line(text, said, capsys, place):
    (place / "sweep.toml").write_text(text)
    assert sweep.main(["sweep.toml"]) == USAGE
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("purerl: ") and said in line


@pytest.mark.parametrize("package", ["optuna", "submitit"])
def test_without_the_package_there_is_a_line_to_paste(package, capsys, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *_: None)
    words = ["--grid", "ppo.gamma=0.9", "--slurm", "cluster=local"]
    if package == "optuna":
        words = ["--optuna", "3", "--over", "ppo.gamma=0.9..1"]
    assert sweep.main([str(TOY), *words]) == USAGE
    line = purerl.how_to_install("sweep")
    assert (
        capsys.readouterr().err == f"purerl: The package {package} is not installed; run: {line}\n"
    )


@pytest.mark.parametrize("name", ["sweep.csv", "sweep.txt", "sweep.png", ".lock", "optuna.db"])
def test_a_link_in_its_folder_is_refused(capsys, place, name):
    folder, target = place / "sweeps/toy_experiment", place / "target"
    folder.mkdir(parents=True)
    (folder / name).symlink_to(target)
    assert sweep.main([str(TOY), "--grid", "ppo.gamma=0.9"]) == USAGE
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{name} is no file, but a link or worse: remove it." in line and not target.exists()


def test_a_pattern_of_slurm_in_its_name_is_refused():
    with pytest.raises(UserError, match="sweeps/a%j has a %, which SLURM reads as a pattern"):
        slurm.check("timeout_min=5", Path("sweeps/a%j"))
    slurm.check("timeout_min=5,cluster=local", Path("sweeps/a%j"))


def test_what_a_refusal_says_to_paste_is_quoted(capsys, place):
    (place / "my toy.py").write_text(TOY.read_text())
    for words in (["--grid", "ppo.lr=1"], ["--grid", "ppo.gamma=x"], ["--nothing", "1"]):
        assert sweep.main(["my toy.py", *words]) == USAGE
        assert "python -m purerl.run 'my toy.py' --help" in capsys.readouterr().err
    assert run.main(["my toy.py", "--nothing", "1"]) == USAGE
    assert "python -m purerl.run 'my toy.py' --help" in capsys.readouterr().err


def test_a_study_that_the_disk_refuses_is_one_line(place):
    from purerl.tune.sweep import study

    optuna = pytest.importorskip("optuna")
    refused = pytest.raises(UserError, match="a/optuna.db cannot be written: .*disk is full")
    with refused, study.kept(Path("a")):
        raise optuna.exceptions.StorageInternalError("database or disk is full")
    with pytest.raises(ZeroDivisionError), study.kept(Path("a")):
        raise ZeroDivisionError


@pytest.mark.slow
def test_shards_and_vmapped_seeds_are_refused_as_by_a_run(capsys):
    words = [str(TOY), "--num-shards", "2"]
    assert run.main([*words, "--num-seeds", "3", "--no-cache"]) == USAGE
    said = capsys.readouterr().err
    assert "num_shards is 2" in said
    assert sweep.main([*words, "--grid", "ppo.gamma=0.9", "--seeds", "3"]) == USAGE
    assert capsys.readouterr().err == said
    for more in (["--seeds-by", "map"], ["--seeds", "1"]):
        assert len(dry(capsys, *words, "--grid", "ppo.gamma=0.9", *more)) == 1


def test_without_evaluations_another_metric_may_rank(capsys):
    words = ["--grid", "evaluation.number=0,3", "--metric", "train/episode_return"]
    assert len(dry(capsys, str(TOY), *words)) == 2


def test_help_names_every_option(capsys):
    assert sweep.main(["--help"]) == SUCCESS
    said = capsys.readouterr().out
    assert all(word in said for word in ("--grid", "--over", "--optuna", "--slurm", "--dry-run"))
