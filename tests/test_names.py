"""Docstrings and comments name files, modules and what is in them: all of those exist."""

import ast
import importlib.util
import io
import re
import subprocess
import sys
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
TRACKED = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
FILES = TRACKED.stdout.split()
EXPLAINED = [
    f for f in FILES if f.endswith(".py") and f.startswith(("purerl/", "envs/", "experim"))
]
# A name with a folder before it, or in backticks: `losses.py`, core/parts.py.
FILE = re.compile(r"`([\w./-]+\.py)`|(?<![\w./-])([\w-]+/[\w./-]*\w\.py)\b")
DOTTED = re.compile(r"(?<![\w./\"'])((?:[a-z_]\w*\.)+)([A-Z]\w*)\b")
# What a user's own file is called in examples.
EXAMPLES = {"mine.py", "experiment.py", "environment.py", "my_experiment.py", "sitecustomize.py"}
SHORT = {"mjx"}  # names that packages are imported by


def explanations(text):
    """Yields the line and the text of each comment and each docstring."""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string
    for node in ast.walk(ast.parse(text)):
        words = getattr(node.value, "value", None) if isinstance(node, ast.Expr) else None
        if isinstance(words, str):
            yield node.lineno, words


def exists(file, name):
    """Tells whether a file that `file` names is there, however much of its path is said."""
    near = str(Path(file).parent / name)
    return any(f in (name, near) or f.endswith(f"/{name}") for f in FILES)


def defined(text):
    """Returns the names that a module has at its top level, or imports anywhere."""
    tree, names = ast.parse(text), set()
    for node in tree.body:
        names |= {getattr(node, "name", "")}
        targets = getattr(node, "targets", [getattr(node, "target", None)])
        names |= {t.id for t in targets if isinstance(t, ast.Name)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names |= {(alias.asname or alias.name).split(".")[0] for alias in node.names}
    return names


def modules():
    """Returns the last name of each module -> what it defines, of all modules of that name."""
    # What the front door has is told by its stub.
    found = {"purerl": defined((ROOT / "purerl" / "__init__.pyi").read_text())}
    for file in EXPLAINED:
        path = Path(file)
        stem = path.parent.name if path.stem == "__init__" else path.stem
        found.setdefault(stem, set()).update(defined((ROOT / file).read_text()))
    return found


MODULES = modules()


def gone(file, text):
    """Returns what a file's docstrings and comments name that does not exist."""
    found = []
    own = defined(text)
    for line, words in explanations(text):
        for match in FILE.finditer(words):
            name = match[1] or match[2]
            if Path(name).name not in EXAMPLES and not exists(file, name):
                found.append(f"line {line}: {name}")
        for match in DOTTED.finditer(words):
            *_, module = match[1].rstrip(".").split(".")
            root = match[1].split(".")[0]
            if match[2] in MODULES.get(module, ()):
                continue
            known = root in sys.stdlib_module_names | SHORT | (own - set(MODULES))
            if not known and (root in MODULES or importlib.util.find_spec(root) is None):
                found.append(f"line {line}: {match[0]}")
    return found


@pytest.mark.parametrize("file", EXPLAINED)
def test_what_a_file_names_is_there(file):
    assert gone(file, (ROOT / file).read_text()) == []


@pytest.mark.parametrize(
    "words, name",
    [
        ("# normalizer.Statistics of the observation", "normalizer.Statistics"),
        ('"""As `warp_batch.py` does."""', "warp_batch.py"),
        ("# core/no_such.py has it", "core/no_such.py"),
        ("# running_moments.Statistic", "running_moments.Statistic"),
    ],
)
def test_a_name_that_is_gone_is_found(words, name):
    assert gone("purerl/ppo/losses.py", f"{words}\n") == [f"line 1: {name}"]


def test_names_that_exist_are_not_blamed():
    text = "# running_moments.Statistics, `losses.py`, core/parts.py, jax.Array, purerl.Config\n"
    assert gone("purerl/ppo/losses.py", text) == []
