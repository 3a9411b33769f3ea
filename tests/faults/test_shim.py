"""The shim: what it records is what the disk holds, and what it makes fail, fails."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.faults import disk, shim

pytestmark = pytest.mark.skipif(not shim.has_compiler(), reason="it is compiled with cc")
ROOT = Path(__file__).parent.parent.parent
BEGIN = """
import errno, json, os, shutil, sys, threading
from pathlib import Path
from tests.faults import shim
assert shim.loaded()
root, log = Path(sys.argv[1]), Path(sys.argv[2])
"""
# Every way in which Python changes files.
CHANGES = """
with shim.armed(root, log):
    (root / "a").write_text("first")
    with (root / "a").open("a") as file:
        file.write(" second")
    with (root / "a").open("r+") as file:
        file.seek(2); file.write("XY"); file.flush(); os.fsync(file.fileno())
    (root / "a").write_text("anew")
    shutil.copyfile(__file__ if "__file__" in globals() else sys.executable, root / "copy")
    os.truncate(root / "copy", 1000)
    file = os.open(root / "b", os.O_RDWR | os.O_CREAT)
    os.write(file, b"0123456789"); os.pwrite(file, b"ab", 3); os.writev(file, [b"x", b"", b"yz"])
    os.pwritev(file, [b"p", b"q"], 20); os.ftruncate(file, 21); os.posix_fallocate(file, 0, 30)
    os.copy_file_range(os.open(root / "a", os.O_RDONLY), file, 4)
    os.close(file)
    (root / "d" / "e" / "f").mkdir(parents=True)
    (root / "d" / "e" / "f" / "x").write_bytes(b"x" * 100_000)
    os.replace(root / "a", root / "d" / "a")
    os.rename(root / "d", root / "moved")
    os.chdir(root)
    Path("relative").write_text("r")
    Path("moved/../relative").rename(".//other")
    os.link("other", "twice")
    folder = os.open("moved", os.O_RDONLY)
    os.mkdir("at", dir_fd=folder)
    os.rename("a", "at/a", src_dir_fd=folder, dst_dir_fd=folder)
    os.fsync(folder)
    shutil.rmtree(root / "moved" / "e")
    held = open("doomed", "a"); os.remove("doomed"); held.write("?"); held.close()
    def many(name):
        for n in range(50):
            Path(name).write_text(str(n))
            os.replace(name, name + "-done")
    threads = [threading.Thread(target=many, args=(name,)) for name in ("s", "t", "u")]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
Path("after").write_text("not recorded")
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    return shim.build(tmp_path_factory.mktemp("shim"))


@pytest.fixture
def under(library, tmp_path):
    """Runs a program under the shim; returns what it printed, as JSON."""
    root = tmp_path / "root"
    root.mkdir()

    def call(code: str, **variables: str):
        done = subprocess.run(
            [sys.executable, "-c", BEGIN + code, str(root), str(tmp_path / "log")],
            env=shim.environment(library, **variables), cwd=ROOT, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout) if done.stdout else None

    return call


def test_what_is_recorded_is_what_the_disk_holds(under, tmp_path):
    under(CHANGES)
    root = tmp_path / "root"
    (root / "after").unlink()
    model = disk.Disk(root)
    for change in disk.read_record(tmp_path / "log"):
        model.apply(change)
    assert model.tree("written") == disk.read_tree(root)
    kinds = {change.kind for change in disk.read_record(tmp_path / "log")}
    assert kinds == {
        "create", "write", "truncate", "fsync", "rename", "link", "mkdir", "remove"
    }  # fmt: skip


def test_a_process_that_is_armed_by_its_environment_records_too(under, tmp_path):
    under("(root / 'a').write_text('x')", **shim.armed_by(tmp_path / "root", tmp_path / "log"))
    assert [change.kind for change in disk.read_record(tmp_path / "log")] == ["create", "write"]


def test_what_has_no_model_is_told(under, tmp_path):
    under("with shim.armed(root, log): os.symlink('a', root / 'b')")
    with pytest.raises(RuntimeError, match="no model of this call"):
        disk.read_record(tmp_path / "log")


def test_nothing_outside_of_the_root_counts(under, tmp_path):
    beside = tmp_path / "root-beside"
    under(f"with shim.armed(root, log): Path({str(beside)!r}).write_text('x')")
    assert beside.read_text() == "x" and disk.read_record(tmp_path / "log") == []


CALLS = {
    "open": "open(root / 'there')",
    "create": "open(root / 'new', 'w')",
    "read": "os.read(there, 5)",
    "write": "os.write(there, b'x')",
    "fsync": "os.fsync(there)",
    "truncate": "os.ftruncate(there, 1)",
    "rename": "os.replace(root / 'there', root / 'elsewhere')",
    "link": "os.link(root / 'there', root / 'twice')",
    "mkdir": "os.mkdir(root / 'folder')",
    "remove": "os.unlink(root / 'there')",
    "list": "os.listdir(root)",
    "lock": "__import__('fcntl').flock(there, 2)",
    "stat": "os.stat(root / 'there')",
}


@pytest.mark.parametrize("kind", CALLS)
def test_a_call_of_every_kind_fails_once_and_is_told(under, tmp_path, kind):
    assert tuple(CALLS) == shim.KINDS
    found = under(f"""
(root / "there").write_text("x")
there = os.open(root / "there", os.O_RDWR)
shim.arm(root, fault=shim.Fault(({kind!r},), 1, "EIO"))
try:
    {CALLS[kind]}
except OSError as error:
    met = error.errno
{CALLS[kind]}
print(json.dumps([met, shim.disarm()]))
""")
    assert found[0] == 5
    assert found[1].startswith(f"EIO {kind} {tmp_path}/root")


def test_the_nth_call_fails_and_with_once_false_all_after_it(under):
    found = under("""
def tried(once):
    shim.arm(root, fault=shim.Fault(("create", "mkdir"), 2, "ENOSPC", once))
    met = []
    for n in range(4):
        try:
            (root / f"{once}{n}").mkdir()
            met.append(0)
        except OSError as error:
            met.append(error.errno)
    shim.disarm()
    return met
print(json.dumps([tried(True), tried(False)]))
""")
    assert found == [[0, 28, 0, 0], [0, 28, 28, 28]]


def test_half_of_the_bytes_are_read_and_written(under, tmp_path):
    found = under("""
there = os.open(root / "there", os.O_RDWR | os.O_CREAT)
shim.arm(root, log, fault=shim.Fault(("write",), 1, "half"))
written = os.write(there, b"12345678")
shim.arm(root, fault=shim.Fault(("read",), 1, "half"))
os.lseek(there, 0, 0)
print(json.dumps([written, os.read(there, 4).decode(), shim.disarm()]))
""")
    assert found[:2] == [4, "12"] and found[2].startswith("half read")
    assert disk.read_record(tmp_path / "log")[-1].data == b"1234"


def test_every_call_is_traced(under, tmp_path):
    under("""
with shim.armed(root, trace=log):
    (root / "a").write_text("x")
    os.path.exists(root / "a")
    os.replace(root / "a", root / "b")
    os.path.exists("/")
""")
    lines = [line.split(" ") for line in (tmp_path / "log").read_text().splitlines()]
    assert [kind for kind, _ in lines] == ["create", "write", "stat", "rename"]
    assert {path for _, path in lines} == {f"{tmp_path}/root/a"}


def test_children_of_an_armed_process_are_left_in_peace(under, tmp_path):
    variables = shim.armed_by(tmp_path / "root", fault=shim.Fault(("mkdir",), 1, "EIO"))
    under(
        "import subprocess\nsubprocess.run(['mkdir', str(root / 'a')], check=True)\n"
        "try:\n    (root / 'b').mkdir()\nexcept OSError:\n    pass",
        **variables,
    )
    assert os.listdir(tmp_path / "root") == ["a"]
