"""A run in one file: what comes along, that it goes on elsewhere, what is not opened."""

import io
import shutil
import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest

import purerl
from purerl import pack, run
from purerl.core.errors import SUCCESS
from purerl.machine.file_reads import reads_among
from purerl.runs.packing import as_archive, unpack
from tests.mistakes.play import MINE

# Bits are compared with those of a run that is compiled so too.
pytestmark = pytest.mark.usefixtures("file_is_compiled_quickly")

READS = """
    mujoco.MjModel.from_xml_path("bodies/arm.xml")
    goal = np.load("goal.npy")
    return own.env.with_goal(Env(), goal)
"""
OWN = """def with_goal(env, goal):
    env.goal = goal
    return env
"""
ARM = '<mujoco><include file="hand.xml"/></mujoco>'
HAND = '<mujoco><worldbody><geom size="1"/></worldbody></mujoco>'
FILES = {
    "own/__init__.py": "",
    "own/env.py": OWN,
    "bodies/arm.xml": ARM,
    "bodies/hand.xml": HAND,
    "notes.txt": "nobody reads this",
    ".secret": "nor this",
}
READ = {"mine.py", "own/__init__.py", "own/env.py", "bodies/arm.xml", "bodies/hand.xml", "goal.npy"}
FEW = {"ppo.num_steps": 64, "evaluation.number": 1}


def is_own(name: str) -> bool:
    return name.partition(".")[0] == "own"


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    """A run of a project with a package, an MJCF that includes another, and data; and its file."""
    with pytest.MonkeyPatch.context() as patch:
        project = tmp_path_factory.mktemp("project")
        patch.chdir(project)
        patch.syspath_prepend(project)
        text = MINE.replace("import purerl\n", "import own.env\nimport purerl\n", 1)
        text = text.replace("\n    return Env()\n", READS)
        text = text.replace("1.0 - distance", "self.goal[0] - distance")
        (project / "mine.py").write_text(text)
        for name, content in FILES.items():
            (project / name).parent.mkdir(exist_ok=True)
            (project / name).write_text(content)
        np.save("elsewhere.npy", np.ones(3, np.float32))
        (project / "goal.npy").symlink_to("elsewhere.npy")
        trained = purerl.train("mine.py", FEW, name="a", seed=4, checkpoints=4)
        digest = trained.digest
        assert pack.main([str(trained.folder)]) == SUCCESS
    for name in filter(is_own, list(sys.modules)):
        del sys.modules[name]
    return project, digest


def test_what_the_run_reads_comes_along_and_nothing_else(packed):
    with tarfile.open(packed[0] / "mine-a.tar.gz") as archive:
        facts = archive.extractfile("runs/mine/a/manifest.json").read()
        names = {name for name in archive.getnames() if not name.startswith("runs/mine/a/")}
        kept = {name.split("/")[4] for name in archive.getnames() if "/checkpoints/" in name}
    assert names == READ
    assert kept == {"000000000002"}, "the newest, which is the best"
    assert str(packed[0]).encode() not in facts, "it says nothing of this machine"


def test_it_goes_on_elsewhere_without_settings(packed, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    assert pack.main([str(packed[0] / "mine-a.tar.gz"), "--open"]) == SUCCESS
    said = capsys.readouterr().out.splitlines()
    assert said[1:3] == ["cd mine-a", "purerl evaluate runs/mine/a --trust"]
    assert said[3] == "purerl run mine.py --name a --resume"
    monkeypatch.chdir("mine-a")
    monkeypatch.syspath_prepend(Path.cwd())
    shutil.move(packed[0], tmp_path / "gone")
    for name in filter(is_own, list(sys.modules)):
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(purerl.UserError, match="not known on this machine"):
        purerl.load("runs/mine/a").policy  # noqa: B018
    assert purerl.load("runs/mine/a", trust=True).evaluate(2)["digest"] == packed[1]
    assert "any more" not in capsys.readouterr().out
    assert run.main(["mine.py", "--name", "a", "--resume"]) == SUCCESS
    assert f"Already done: 2 updates. Digest {packed[1]}" in capsys.readouterr().out


def archive_of(name: str, kind: bytes = tarfile.REGTYPE, link: str = "") -> bytes:
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w:gz") as archive:
        member = tarfile.TarInfo(name)
        member.type, member.linkname = kind, link
        archive.addfile(member)
    return content.getvalue()


WHOLE = as_archive({Path("runs/a/b/config.json"): bytes(range(256)) * 9})


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (archive_of("/etc/passwd"), "/etc/passwd is no file of a run"),
        (archive_of("a/../../b"), "a/../../b is no file of a run"),
        (archive_of("a", tarfile.SYMTYPE, "../b"), "a is no file of a run"),
        (archive_of("a", tarfile.LNKTYPE, "b"), "a is no file of a run"),
        (archive_of("a", tarfile.FIFOTYPE), "a is no file of a run"),
        (WHOLE[:-9], "Compressed file ended"),
        (WHOLE[:-8] + b"\0" + WHOLE[-7:], "CRC check failed"),
        (b"no archive", "Not a gzipped file"),
    ],
    ids=range(8),  # an archive has the time in it, which would be in the test's name
)
def test_what_is_hostile_or_damaged_is_not_opened(tmp_path, content, said):
    (tmp_path / "a.tar.gz").write_bytes(content)
    with pytest.raises(purerl.UserError, match="a.tar.gz cannot be opened: .*") as told:
        unpack(tmp_path / "a.tar.gz", tmp_path / "a")
    assert said in str(told.value) and not (tmp_path / "a").exists()


def test_a_folder_that_is_there_is_not_written_into(tmp_path):
    (tmp_path / "a.tar.gz").write_bytes(WHOLE)
    unpack(tmp_path / "a.tar.gz", tmp_path / "a")
    (tmp_path / "a/runs/a/b/config.json").write_text("mine")
    with pytest.raises(purerl.UserError, match="File exists"):
        unpack(tmp_path / "a.tar.gz", tmp_path / "a")
    assert (tmp_path / "a/runs/a/b/config.json").read_text() == "mine"


def test_files_that_cannot_be_watched_are_told(tmp_path):
    with (
        pytest.raises(purerl.UserError, match="gone cannot be watched"),
        reads_among([tmp_path / "gone"]),
    ):
        pass
