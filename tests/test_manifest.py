"""What a run depends on is written down, and told apart from what it does not depend on."""

from purerl import manifest


def test_differences_are_named_by_path():
    old = {"versions": {"jax": "1", "flax": "2"}, "engine": "c", "git_revision": "a"}
    new = {"versions": {"jax": "1.1", "flax": "2"}, "flags": {}, "git_revision": "b"}
    assert manifest.differences(old, new) == [
        "engine: c -> (absent)",
        "flags: (absent) -> {}",
        "versions.jax: 1 -> 1.1",
    ]


def test_the_fingerprint_follows_what_can_change_bits_only():
    facts = manifest.collect("c", [])
    same = manifest.fingerprint(facts | {"git_revision": "other", "run_id": "x"})
    assert manifest.fingerprint(facts) == same
    assert manifest.fingerprint(facts | {"engine": "jax"}) != same


def test_a_pinned_thread_pool_counts_as_pinned(monkeypatch):
    monkeypatch.setenv("NPROC", "13")
    assert manifest.cpu_threads() == 13


def test_the_source_is_what_the_run_imports_and_nothing_else():
    found = manifest.imported_files(["purerl.ppo", "tests.toy_experiment"])
    assert {"purerl.gae", "purerl.losses", "tests.probes", "purerl.networks"} <= set(found)
    assert not {"purerl.console", "tests.test_run", "jax"} & set(found)


def test_an_edit_changes_the_source_hash(tmp_path, monkeypatch):
    package = tmp_path / "bodies_and_tasks"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "task.py").write_text(
        "from bodies_and_tasks import body\n\ndef build():\n    pass\n"
    )
    (package / "body.py").write_text("LEGS = 4\n")
    (package / "other.py").write_text("LEGS = 4\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    import bodies_and_tasks.task as task

    before = manifest.source_hash([task.build])
    (package / "other.py").write_text("LEGS = 8\n")
    assert manifest.source_hash([task.build]) == before
    (package / "body.py").write_text("LEGS = 6\n")
    assert manifest.source_hash([task.build]) != before
