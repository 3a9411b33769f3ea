"""The model of a file system after a power cut, by cases worked by hand."""

import pytest

from tests.faults.disk import MODELS, Change, Disk, read_tree, trees, write_tree

INODES = {"a": 1, "b": 2, "d": 3, "e": 4, "d/a": 5, "root": 99}


def create(path):
    return Change("create", INODES[path], 0, f"/root/{path}", "", b"")


def write(path, data, at=0):
    return Change("write", INODES[path], at, f"/root/{path}", "", data)


def truncate(path, length):
    return Change("truncate", INODES[path], length, f"/root/{path}", "", b"")


def fsync(path):
    return Change("fsync", INODES[path], 0, f"/root/{path}", "", b"")


def rename(path, other):
    return Change("rename", 0, 0, f"/root/{path}", f"/root/{other}", b"")


def mkdir(path):
    return Change("mkdir", INODES[path], 0, f"/root/{path}", "", b"")


def remove(path):
    return Change("remove", 0, 0, f"/root/{path}", "", b"")


def after(*changes):
    disk = Disk("/root")
    for change in changes:
        disk.apply(change)
    return disk


def left(*changes):
    disk = after(*changes)
    return {model: disk.tree(model) for model in MODELS}


def test_nothing_is_promised_without_fsync():
    assert left(create("a"), write("a", b"four")) == {
        "strict": {},
        "names": {"a": b""},
        "torn": {"a": b"fo"},
        "zeros": {"a": b"\0\0\0\0"},
        "written": {"a": b"four"},
    }


def test_bytes_are_promised_by_the_file_and_names_by_the_folder():
    begun = [create("a"), write("a", b"x")]
    assert after(*begun, fsync("a")).tree("strict") == {}
    assert after(*begun, fsync("root")).tree("strict") == {"a": b""}
    assert after(*begun, fsync("a"), fsync("root")).tree("strict") == {"a": b"x"}
    assert after(*begun, fsync("root"), fsync("a")).tree("strict") == {"a": b"x"}


def test_of_appended_bytes_the_promised_ones_stay():
    found = left(create("a"), write("a", b"1\n"), fsync("a"), fsync("root"), write("a", b"2\n", 2))
    assert [found[model]["a"] for model in MODELS] == [
        b"1\n", b"1\n", b"1\n2", b"1\n\0\0", b"1\n2\n"
    ]  # fmt: skip


def test_bytes_written_over_a_file_may_leave_the_old_ones():
    old = [create("a"), write("a", b"old"), fsync("a"), fsync("root")]
    found = left(*old, truncate("a", 0), write("a", b"new!"))
    assert [found[m]["a"] for m in MODELS] == [b"old", b"old", b"ne", b"\0\0\0\0", b"new!"]


def test_a_write_beyond_the_end_fills_with_zeros_and_one_inside_keeps_the_rest():
    assert after(create("a"), write("a", b"x", 2)).tree("written") == {"a": b"\0\0x"}
    assert after(create("a"), write("a", b"abcd"), write("a", b"X", 1)).tree("written") == {
        "a": b"aXcd"
    }


def test_a_rename_over_a_file_without_fsync_leaves_an_empty_file():
    old = [create("a"), write("a", b"old"), fsync("a"), fsync("root")]
    draft = [create("b"), write("b", b"new")]
    found = left(*old, *draft, rename("b", "a"))
    assert found["names"] == {"a": b""}, "ext4: a file of length zero in the place of a whole one"
    assert found["strict"] == {"a": b"old"}
    found = left(*old, *draft, fsync("b"), rename("b", "a"))
    assert found["names"] == {"a": b"new"} and found["strict"] == {"a": b"old"}
    assert left(*old, *draft, fsync("b"), rename("b", "a"), fsync("root"))["strict"] == {
        "a": b"new"
    }


def test_a_folder_is_renamed_with_what_is_in_it():
    begun = [mkdir("d"), create("d/a"), write("d/a", b"x"), fsync("d/a"), fsync("d")]
    assert after(*begun).tree("strict") == {}, "nobody promised the folder's own name"
    assert after(*begun, fsync("root")).tree("strict") == {"d": None, "d/a": b"x"}
    moved = after(*begun, fsync("root"), rename("d", "e"))
    assert moved.tree("strict") == {"d": None, "d/a": b"x"}
    assert moved.tree("names") == {"e": None, "e/a": b"x"}
    moved.apply(fsync("root"))
    assert moved.tree("strict") == {"e": None, "e/a": b"x"}


@pytest.mark.parametrize("promised", ["root", "d"])
def test_a_rename_between_folders_comes_whole(promised):
    begun = [mkdir("d"), create("a"), write("a", b"x"), fsync("a"), fsync("root"), fsync("d")]
    moved = after(*begun, rename("a", "d/a"))
    assert moved.tree("strict") == {"d": None, "a": b"x"}
    moved.apply(fsync(promised))
    assert moved.tree("strict") == {"d": None, "d/a": b"x"}, "never in both places, nor in none"


def test_a_promise_brings_what_a_rename_between_folders_stands_on():
    # The name of `a` was never promised itself.
    moved = after(mkdir("d"), fsync("root"), create("a"), fsync("a"), rename("a", "d/a"))
    moved.apply(fsync("d"))
    assert moved.tree("strict") == {"d": None, "d/a": b""}


def test_a_tree_that_was_removed_may_come_back_whole_or_in_part():
    begun = [mkdir("d"), create("d/a"), fsync("d/a"), fsync("d"), fsync("root")]
    gone = after(*begun, remove("d/a"), remove("d"))
    assert gone.tree("strict") == {"d": None, "d/a": b""} and gone.tree("names") == {}
    part = after(*begun, remove("d/a"), fsync("d"), remove("d"))
    assert part.tree("strict") == {"d": None}
    part.apply(fsync("root"))
    assert part.tree("strict") == {}


def test_an_inode_that_is_used_again_is_another_file():
    again = [remove("a"), Change("create", INODES["a"], 0, "/root/b", "", b"")]
    disk = after(create("a"), write("a", b"old"), fsync("a"), fsync("root"), *again)
    assert disk.tree("strict") == {"a": b"old"} and disk.tree("written") == {"b": b""}


def test_a_second_name_is_the_same_file():
    link = Change("link", INODES["a"], 0, "/root/a", "/root/b", b"")
    disk = after(create("a"), link, write("a", b"x"), rename("a", "b"))
    assert disk.tree("written") == {"a": b"x", "b": b"x"}
    assert after(create("a"), link, remove("a"), write("a", b"x")).tree("written") == {"b": b"x"}


def test_a_cut_leaves_what_was_done_before_it():
    changes = [create("a"), write("a", b"x"), fsync("a")]
    found = {(n, model): tree for n, model, tree in trees(Disk("/root"), changes, range(4))}
    assert len(found) == 4 * len(MODELS)
    assert found[0, "written"] == {} and found[1, "written"] == {"a": b""}
    assert found[2, "names"] == {"a": b""} and found[3, "names"] == {"a": b"x"}
    few = trees(Disk("/root"), changes, {1, 3}, ("names",))
    assert list(few) == [(1, "names", {"a": b""}), (3, "names", {"a": b"x"})]


def test_a_tree_is_written_as_it_is_read(tmp_path):
    tree = {"d": None, "d/e": None, "d/e/a": b"x", "b": b""}
    write_tree(tree, tmp_path)
    assert read_tree(tmp_path) == tree


def test_what_was_there_before_is_on_the_disk(tmp_path):
    write_tree({"d": None, "d/a": b"old"}, tmp_path)
    disk = Disk(tmp_path, begun=True)
    assert all(disk.tree(model) == {"d": None, "d/a": b"old"} for model in MODELS)
    inode = (tmp_path / "d" / "a").stat().st_ino
    disk.apply(Change("write", inode, 3, "", "", b" new"))
    disk.apply(Change("rename", 0, 0, f"{tmp_path}/d", f"{tmp_path}/e", b""))
    assert disk.tree("strict") == {"d": None, "d/a": b"old"}
    assert disk.tree("written") == {"e": None, "e/a": b"old new"}
