"""What loggers get of a run that goes on, and which checkpoint is the best: one short training."""

import importlib.machinery
import json
import shutil
import sys
import types

import pytest

from purerl import run
from purerl.core.errors import SUCCESS, USAGE
from purerl.experiment.options import RunOptions
from purerl.runs import checkpoint_folder
from purerl.training import loggers, session
from tests.experiment.test_source_hashes import TOY

pytestmark = pytest.mark.usefixtures("file_is_compiled_quickly")

WORDS = [str(TOY), "--evaluation.number", "6", "--checkpoints", "2", "--wandb", "offline"]


class Wandb(types.ModuleType):
    """W&B, as far as it is used: a row for each step, none before `step`."""

    __spec__ = importlib.machinery.ModuleSpec("wandb", None)

    def __init__(self, step: int = 0) -> None:
        self.rows: dict[int, dict] = {}
        self.Settings = dict
        self.Video, self.Image = lambda path, format: path, lambda path: path
        self.step = step

    def init(self, **options):
        return self

    def define_metric(self, *names, **options): ...

    def log(self, row, step):
        assert step >= self.step  # others W&B drops
        self.step = step
        self.rows.setdefault(step, {}).update(row)

    def finish(self): ...


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A whole run, and what W&B got of it."""
    place = tmp_path_factory.mktemp("trained")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "wandb", wandb := Wandb())
        assert run.main([*WORDS, "--runs", str(place)]) == SUCCESS
    return place / "toy_experiment" / "seed1", wandb.rows


def lines(folder):
    found = map(json.loads, (folder / "metrics.jsonl").read_text().splitlines())
    return {line["update"]: line for line in found}


def test_a_logger_gets_every_line_with_its_digest(trained):
    folder, rows = trained
    assert rows == lines(folder)
    assert any("digest" in row for row in rows.values())


@pytest.mark.parametrize("known", [0, 5])
def test_a_run_that_goes_on_sends_all_that_the_logger_lacks(trained, tmp_path, monkeypatch, known):
    """Killed after its last checkpoint but one; W&B knows nothing (offline), or some rows."""
    place = tmp_path / "toy_experiment" / "seed1"
    shutil.copytree(trained[0], place)
    shutil.rmtree(checkpoint_folder.path_of(place / "checkpoints", 12))
    monkeypatch.setitem(sys.modules, "wandb", wandb := Wandb(known))
    assert run.main([*WORDS, "--runs", str(tmp_path), "--resume"]) == SUCCESS
    now = lines(place)
    assert [*wandb.rows] == [update for update in now if update >= known]
    for update, row in wandb.rows.items():
        assert row | {"wall_s": 0} == now[update] | {"wall_s": 0}


def test_a_video_and_its_sheet_are_sent_as_of_their_update(trained, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "wandb", wandb := Wandb(5))
    options = RunOptions(wandb="offline")
    for name, step in (("000000000012_side.mp4", 12), ("000000000003.mp4", 12)):  # none before
        video = trained[0] / "videos" / name
        loggers.log_video(options, trained[0], video)
        row = {"video": str(video), "contact_sheet": str(video.with_suffix(".png"))}
        assert wandb.rows[step] == row | {"update": int(name[:12])}
    assert "W&B has it as video and contact_sheet" in capsys.readouterr().out


def test_the_best_evaluation_has_a_checkpoint(trained):
    folder, rows = trained
    scores = {
        k: row["eval/episode_return"] for k, row in rows.items() if "eval/episode_return" in row
    }
    assert len(scores) == 6
    (found,) = checkpoint_folder.best_by_stage(folder / "checkpoints").values()
    assert found[0] == max(scores.values()) and scores[found[1]] == found[0]


def test_a_run_does_not_go_on_with_other_data(trained, monkeypatch, capsys):
    """As if a file that its environment reads had been edited."""
    held = json.loads((trained[0] / "manifest.json").read_text())["arrays"]
    monkeypatch.setattr(session, "hash_held", lambda *of: held | {"float32[3, 4]": "another"})
    place = str(trained[0].parent.parent)
    assert run.main([*WORDS[:-2], "--runs", place, "--resume"]) == USAGE
    said = capsys.readouterr().err
    assert "arrays.float32[3, 4]: (absent) -> another" in said and "Put back the data" in said
