"""A run's folder from a stranger: what is read of it, and what is written to it."""

import copy
import json
import os
import shutil
import socket
import sys
from pathlib import Path

import numpy as np
import pytest

import purerl
from purerl import compare, evaluate, run
from purerl.core.errors import FAILURE, SUCCESS, USAGE
from purerl.runs import checkpoint_folder, metrics_file

pytestmark = [
    pytest.mark.slow,
    pytest.mark.usefixtures("file_is_compiled_quickly", "programs_are_kept"),
]

TOY = Path(__file__).parent / "toy_experiment.py"
FEW = ["--episodes", "1"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("trust")
    (place / "mine.py").write_text(TOY.read_text())
    assert run.main([str(place / "mine.py"), "--runs", str(place), "--checkpoints", "1"]) == SUCCESS
    return place / "mine" / "seed1"


@pytest.fixture
def given(trained, tmp_path) -> Path:
    """A copy of the run, to be spoilt."""
    return Path(shutil.copytree(trained, tmp_path / "given"))


def change(file: Path, **values) -> None:
    file.write_text(json.dumps(json.loads(file.read_text()) | values))


def only_line(capsys) -> str:
    said = capsys.readouterr().err.strip()
    assert said.count("\n") == 0 and said.startswith("purerl: ") and "Traceback" not in said
    return said


def go_on(folder: Path, *more: str) -> int:
    place = folder.parent.parent
    words = ["--runs", str(place), "--name", folder.name, "--checkpoints", "1", "--resume", *more]
    return run.main([str(place / "mine.py"), *words])


def looked_at(folder: Path) -> list:
    """All that reads a run, but for training."""

    def resume() -> int:
        return go_on(folder)

    def metrics() -> int:
        try:
            purerl.load(folder).metrics()
        except purerl.UserError as error:
            print(f"purerl: {error}", file=sys.stderr)
            return USAGE
        return SUCCESS

    return [
        lambda: evaluate.main([str(folder), *FEW]),
        lambda: compare.main([str(folder)]),
        metrics,
        resume,
    ]


@pytest.fixture
def resumable(given, tmp_path) -> Path:
    (tmp_path / "mine.py").write_bytes((given / "experiment.py").read_bytes())
    (tmp_path / "mine").mkdir()
    return given.rename(tmp_path / "mine" / "given")


WHOLE = {
    "nothing": b"",
    "a list": b"[]",
    "a number": b"7",
    "no number": b"NaN",
    "null": b"null",
    "text": b'"x"',
    "half": b'{"experiment": "toy", ',
    "empty": b"{}",
    "bytes": b"\xff\xfe\x00\x01",
    "deep lists": b"[" * 100_000,
    "deep objects": b'{"a":' * 5000 + b"1" + b"}" * 5000,
    "nested": b'{"a":' * 60 + b"1" + b"}" * 60,
    "a long number": b"1" * 5000,
}


@pytest.mark.parametrize("content", WHOLE.values(), ids=WHOLE)
@pytest.mark.parametrize("name", ["config.json", "manifest.json", "metrics.jsonl"])
def test_a_forged_file_is_one_line_that_names_it(resumable, capsys, name, content):
    (resumable / name).write_bytes(content + b"\n")
    evaluated, compared, metrics, resumed = looked_at(resumable)
    if name == "metrics.jsonl":
        readers = [compared, metrics]
    elif name == "manifest.json":
        readers = [evaluated, resumed] + ([compared] if content != b"{}" else [])
    else:
        readers = [evaluated, compared] + ([resumed] if content != b"{}" else [])
    for reader in readers:
        if (name, content) == ("metrics.jsonl", b"{}") and reader is metrics:
            continue
        assert reader() == USAGE
        assert str(resumable / name) in only_line(capsys)


def paths(value, path=()):
    """The places of all values inside of a JSON value."""
    inside = value.items() if isinstance(value, dict) else ()
    inside = enumerate(value) if isinstance(value, list) else inside
    return [path, *(place for key, one in inside for place in paths(one, (*path, key)))]


def forged(value, path, bad):
    value = copy.deepcopy(value)
    at = value
    for key in path[:-1]:
        at = at[key]
    if bad is KeyError:
        del at[path[-1]]
    else:
        at[path[-1]] = bad
    return value


BAD = [
    None, [], {}, "x", "", -1, 0, 1e300, float("nan"), 10**30, [[1]], {"a": {"b": 1}}, "\x1b[2J",
    "\ud800", KeyError, float("inf"), True,
]  # fmt: skip


@pytest.mark.slow
def test_every_forged_value_is_read_or_one_line(given, capsys):
    """Each value of the two files becomes some of these; beyond their heads nobody looks."""
    number = refused = 0
    for name in ("config.json", "manifest.json"):
        text = (given / name).read_text()
        for path in paths(json.loads(text))[1:]:
            if name == "manifest.json" and len(path) > 1:
                continue
            for bad in (BAD[(number + i) % len(BAD)] for i in (0, 5, 11)):
                (given / name).write_text(json.dumps(forged(json.loads(text), path, bad)))
                try:
                    purerl.load(given).restored  # noqa: B018
                except purerl.UserError as error:
                    refused += 1
                    assert "\n" not in str(error), (path, bad)
                assert compare.main([str(given)]) in (SUCCESS, USAGE), (path, bad)
                assert "Traceback" not in capsys.readouterr().err, (path, bad)
                number += 1
        (given / name).write_text(text)
    assert number > 150 and 0.2 < refused / number < 0.9


@pytest.mark.parametrize(
    ("file", "path", "bad", "said"),
    [
        (
            "config.json",
            ("settings", "ppo", "num_envs"),
            "8",
            "ppo.num_envs is '8'; it must be int",
        ),
        (
            "config.json",
            ("settings", "env", "steps"),
            [4],
            "env.steps is [4]; it must be int, such",
        ),
        (
            "config.json",
            ("settings", "network", "policy_hidden"),
            ["x"],
            "tuple[int, ...], such as",
        ),
        ("config.json", ("settings", "engine"), "q", "it must be Literal['auto', "),
        ("config.json", ("settings",), 5, "settings is 5; it must be an object"),
        ("config.json", ("experiment",), KeyError, "lacks experiment"),
        ("manifest.json", ("experiment_file",), 5, "experiment_file is 5; it must be a string"),
        ("manifest.json", ("source",), [], "source is []; it must be an object"),
        ("manifest.json", ("model",), 1, "model is 1; it must be a string or null"),
    ],
)
def test_a_value_of_another_kind_is_named_with_its_file(given, capsys, file, path, bad, said):
    value = forged(json.loads((given / file).read_text()), path, bad)
    (given / file).write_text(json.dumps(value))
    assert evaluate.main([str(given), *FEW]) == USAGE
    line = only_line(capsys)
    assert said in line and file in line


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ('{"update": "1", "steps": 1}', "update is '1'"),
        ('{"update": 1}', "lacks steps"),
        ('{"update": 1, "steps": true}', "steps is True"),
        (f'{{"update": 1, "steps": {10**30}}}', "steps is 1000"),
        ('{"update": 1, "steps": 1, "digest": 5}', "digest is 5"),
        ('{"update": 1, "steps": 1, "digest": {}}', "digest is {}"),
        ('{"update": 1, "steps": 1, "eval/episode_return": "9"}', "episode_return is '9'"),
        ('{"update": 1, "steps": 1, "train/skipped_in_a_row": [3]}', "in_a_row is [3]"),
        ('{"update": 1, "steps": 1, "where": {}, "value": 0}', "where is {}"),
    ],
)
def test_a_forged_line_of_the_metrics_is_named(given, capsys, line, said):
    with (given / "metrics.jsonl").open("a") as file:
        file.write(line + "\n")
    assert compare.main([str(given), str(given)]) == USAGE
    found = only_line(capsys)
    assert f"{given}/metrics.jsonl, line 13" in found and said in found


@pytest.mark.filterwarnings("ignore:overflow")
def test_numbers_that_no_float_holds_are_not_measured(given, tmp_path):
    last = json.loads((given / "metrics.jsonl").read_text().splitlines()[-1])
    with (given / "metrics.jsonl").open("a") as file:
        for value in (10**400, 1e308):
            last |= {"update": last["update"] + 1, "steps": last["steps"] + 1}
            file.write(json.dumps(last | {"eval/episode_return": value}) + "\n")
    assert compare.main([str(given), "--out", str(tmp_path / "out")]) == SUCCESS
    found = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert found["groups"][0]["score"] == 1e308


def test_any_text_is_compared_and_drawn(given, tmp_path, capsys):
    """A label for matplotlib, a cell for a table, a line for a terminal."""
    hostile = "$\\frac{ \x1b[2J\n\ud800\u202e"
    other = Path(shutil.copytree(given, tmp_path / "other"))
    config = json.loads((other / "config.json").read_text())
    config["settings"]["env"]["name"] = config["experiment"] = hostile
    (other / "config.json").write_text(json.dumps(config))
    assert compare.main([str(given), str(other), "--out", str(tmp_path / "out")]) == SUCCESS
    said = capsys.readouterr()
    shown = "$\\frac{ \\x1b[2J\\n\\ud800\\u202e"
    assert shown in said.out and hostile[:10] not in said.out + said.err
    assert (tmp_path / "out" / "curves.png").stat().st_size > 1000


def pipe(path: Path) -> None:
    os.mkfifo(path)


def plug(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as one:
        place = os.getcwd()
        os.chdir(path.parent)  # a socket's path is short
        one.bind(path.name)
        os.chdir(place)


def large(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(metrics_file.LARGEST + 1)


def zeros(path: Path) -> None:
    path.symlink_to("/dev/zero")


@pytest.mark.timeout(60)
@pytest.mark.parametrize("put", [pipe, plug, large, zeros, Path.mkdir], ids=lambda f: f.__name__)
@pytest.mark.parametrize("name", ["config.json", "manifest.json", "experiment.py", "metrics.jsonl"])
def test_what_is_no_file_of_a_run_neither_hangs_nor_fills_the_memory(given, capsys, name, put):
    (given / name).unlink()
    put(given / name)
    evaluated, compared, metrics, _ = looked_at(given)
    readers = [compared] + {"metrics.jsonl": [metrics]}.get(name, [evaluated])
    for reader in readers:
        assert reader() == USAGE
        said = only_line(capsys)
        assert name in said, said
        if put is large:
            assert "bytes, of at most" in said


@pytest.mark.timeout(60)
def test_a_pipe_among_the_arrays_does_not_hang(given, capsys):
    file = next(f for f in (given / "checkpoints").rglob("d/*") if f.is_file())
    file.unlink()
    os.mkfifo(file)
    assert evaluate.main([str(given)]) == USAGE
    assert str(file) in only_line(capsys)


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    "name", ["experiment.py", "metrics.jsonl", "checkpoints/000000000012/meta.json"]
)
def test_a_pipe_does_not_hang_a_run_that_goes_on(resumable, capsys, name):
    (resumable / name).unlink()
    os.mkfifo(resumable / name)
    assert looked_at(resumable)[-1]() == USAGE
    assert name in only_line(capsys)


@pytest.mark.parametrize("name", [".lock", ".config.json.draft", "metrics.jsonl", "experiment.py"])
def test_a_run_that_goes_on_writes_through_no_link(resumable, tmp_path, capsys, name):
    precious = tmp_path / "precious"
    precious.write_text("diary")
    (resumable / name).unlink(missing_ok=True)
    (resumable / name).symlink_to(precious)
    for more in ([], ["--seed", "5", "--allow-changes"]):
        assert go_on(resumable, *more) == USAGE
        assert name in only_line(capsys)
        assert precious.read_text() == "diary"


def test_a_network_that_no_machine_holds_is_refused_before_memory_is_taken(given, capsys):
    path = ("settings", "network", "policy_hidden")
    config = forged(json.loads((given / "config.json").read_text()), path, [10**6, 10**6])
    (given / "config.json").write_text(json.dumps(config))
    assert evaluate.main([str(given), *FEW]) == USAGE
    assert "takes 4,000 GB, by its config.json" in only_line(capsys)


@pytest.mark.parametrize(
    "bad",
    [{"leaves": {"a": 5}}, {"leaves": []}, {"files": {"a\0b": ""}}, {"update": "../x"}, 7, []],
)
def test_forged_metadata_of_a_checkpoint_are_one_line(given, tmp_path, capsys, bad):
    *others, last = sorted((given / "checkpoints").iterdir())
    for other in others:
        shutil.rmtree(other)
    file = last / "meta.json"
    meta = json.loads(file.read_text())
    meta = {**meta, **bad} if isinstance(bad, dict) else bad
    if isinstance(meta, dict):
        del meta["meta_sha256"]
        meta["meta_sha256"] = checkpoint_folder.hash_meta(meta)
    file.write_text(json.dumps(meta))
    assert evaluate.main([str(given), *FEW]) == USAGE
    only_line(capsys)
    other = Path(shutil.copytree(given, tmp_path / "other"))
    text = (other / "metrics.jsonl").read_text()
    (other / "metrics.jsonl").write_text(text.replace('"digest": "', '"digest": "0'))
    assert compare.main([str(given), str(other)]) in (SUCCESS, USAGE, FAILURE)


@pytest.mark.parametrize(
    "bad", [5, [5], [{}], [{"fingerprint": "x", "after_update": 1, "of": 5}], {"a": 1}]
)
def test_forged_changes_are_one_line(resumable, capsys, bad):
    change(resumable / "manifest.json", allowed_changes=bad)
    for reader in (looked_at(resumable)[0], looked_at(resumable)[-1]):
        assert reader() == USAGE
        assert "allowed_changes" in only_line(capsys)


@pytest.mark.parametrize("length", [300, 5000])
def test_a_long_name_is_one_line(tmp_path, capsys, length):
    folder = tmp_path / ("x" * length)
    for reader in looked_at(folder):
        assert reader() == USAGE
        only_line(capsys)
    assert run.main([str(TOY), "--runs", str(folder)]) == USAGE
    assert "File name too long" in only_line(capsys)


def test_a_folder_that_may_not_be_read_is_one_line(given, capsys):
    root = os.geteuid() == 0
    for parent in (given, *given.parents):
        if root and parent.owner() == "root" and parent != Path("/"):
            parent.chmod(parent.stat().st_mode | 0o011)
    given.chmod(0)
    try:
        if root:
            os.seteuid(65534)
        for reader in looked_at(given)[:3]:
            assert reader() == USAGE
            assert "Permission denied" in only_line(capsys)
    finally:
        if root:
            os.seteuid(0)
        given.chmod(0o755)


def test_a_video_is_not_written_through_a_link(given, tmp_path):
    from purerl.report import video

    precious = tmp_path / "precious"
    precious.write_text("diary")
    (given / "videos").mkdir()
    (given / "videos" / ".1.png").symlink_to(precious)
    about = ([np.zeros((32, 32, 3), np.uint8)], 1, (32, 32), 1.0)
    video._write_files(video.videos_of(given) / "1.mp4", *about)
    assert not (given / "videos" / "1.png").is_symlink()
    shutil.rmtree(given / "videos")
    (given / "videos").symlink_to(tmp_path)
    with pytest.raises(purerl.UserError, match="leaves the run's folder"):
        video.videos_of(given)
    assert precious.read_text() == "diary"


# --- names ---


@pytest.mark.parametrize(
    "name",
    [
        "../x",
        "/tmp/x",
        "",
        ".",
        "..",
        "a/b",
        "-x",
        "a\nb",
        "\x1b[2J",
        "x" * 201,
        "ä" * 101,
        "\u202e",
    ],
)
def test_a_name_is_that_of_one_folder(tmp_path, capsys, name):
    assert run.main([str(TOY), "--runs", str(tmp_path / "runs"), f"--name={name}"]) == USAGE
    said = only_line(capsys)
    assert "it must be the name of one folder" in said and said.isprintable()
    assert not list(tmp_path.iterdir())


def test_an_experiments_name_is_too(tmp_path, capsys):
    for stem in ("-x", "a\nb"):
        file = tmp_path / f"{stem}.py"
        file.write_text(TOY.read_text())
        assert run.main([str(file), "--runs", str(tmp_path / "runs")]) == USAGE
        assert "it must be the name of one folder" in only_line(capsys)
    assert not (tmp_path / "runs").exists()
