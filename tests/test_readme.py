"""What the pages tell a reader to type, import and open is there."""

import ast
import contextlib
import functools
import importlib
import importlib.util
import io
import re
import shlex
from pathlib import Path

import pytest

import purerl
from purerl.__main__ import COMMANDS

ROOT = Path(__file__).parent.parent
PAGES = {str(p.relative_to(ROOT)): p for p in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]}
FENCED = re.compile(r"^```(\w*)(?: [^\n]*)?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"(?:^    .+\n)+", re.MULTILINE)
INLINE = re.compile(r"`([^`]+)`")
LINK = re.compile(r"\]\(([^)]+)\)")
FOLDERS = {path.name for path in ROOT.iterdir() if path.is_dir()} - {"runs"}


def blocks(text, language):
    """Returns the fenced blocks of one language."""
    return [body for name, body in FENCED.findall(text) if name == language]


def inline(text):
    """Returns what stands in backticks, each on one line."""
    return [" ".join(code.split()) for code in INLINE.findall(FENCED.sub("", text))]


def commands(text):
    """Returns the words of every `python -m MODULE ...`, wherever it stands."""
    lines = [code for code in inline(text) if code.startswith("python -m ")]
    for body in [*blocks(text, "bash"), *INDENTED.findall(FENCED.sub("", text))]:
        lines += re.split(r"\n|&&", body.replace("\\\n", " "))
    words = [shlex.split(line, comments=True) for line in lines if "python -m " in line]
    return [found[2:] for found in words if found[:2] == ["python", "-m"]]


def exists(module):
    """Tells whether `python -m module` finds something to run."""
    try:
        spec = importlib.util.find_spec(module)
    except ModuleNotFoundError:
        return False
    if spec is not None and spec.submodule_search_locations:
        return exists(f"{module}.__main__")
    return spec is not None


# Of which pages tell.
EXPERIMENTS = ("ant_gaps", "ant_intention", "custom_network", "suite", "ant_gaps_reuse")
# Bodies, tasks and experiments are to be built upon: their modules are imported by name.
OURS_BESIDE = ("purerl.envs", "purerl.experiments")


@functools.cache
def help_page(*words):
    """Returns the help page of one of our commands: a module, then what has to stand first."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
        is_room = (ROOT / words[0].replace(".", "/")).is_dir()
        module = f"{words[0]}.__main__" if is_room else words[0]
        importlib.import_module(module).main([*words[1:], "--help"])
    return said.getvalue()


@functools.cache
def all_help():
    """Returns the help pages of all our commands, those of `run` for some experiments."""
    pages = [help_page("purerl.run", name) for name in EXPERIMENTS]
    pages.append(help_page("purerl.experiments.benchmarks.suite_benchmark"))
    return "".join([*pages, *(help_page(f"purerl.{n}") for n in COMMANDS if n != "run")])


def unknown_options(words):
    """Returns the options of one of our commands that its help page does not have."""
    module, *rest = words
    named = rest[: module in ("purerl.run", "purerl.plan", "purerl.view")]
    # These take what `run` takes, or the environment's part of it.
    if module in ("purerl.check", "purerl.ask", "purerl.record", "purerl.render"):
        return [w for w in unknown_options(["purerl.run", *rest]) if w not in help_page(module)]
    page = help_page(module, *(re.sub(r"^runs/(\w+)/.*", r"\1", name) for name in named))
    return [word for word in options(rest) if not re.search(rf"{re.escape(word)}\b", page)]


def options(words):
    return [word.partition("=")[0] for word in words if re.match(r"--\w", word)]


def looks_like_path(code):
    """Tells whether code in backticks names a file or folder of this repository."""
    if not re.fullmatch(r"[\w.-]+(/[\w.-]*)*", code):
        return False
    return code.endswith((".md", ".cff")) or ("/" in code and code.split("/")[0] in FOLDERS)


def sections(page):
    """Returns the anchors of a page's headings, as GitHub makes them."""
    heads = re.findall(r"^#+ (.+)$", FENCED.sub("", page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.fixture(params=sorted(PAGES))
def page(request):
    return PAGES[request.param]


def test_every_module_that_a_page_runs_exists(page):
    modules = {words[0] for words in commands(page.read_text())}
    modules |= {
        code.split()[0]
        for code in inline(page.read_text())
        if re.match(r"(tests|purerl\.experiments)\.\w", code)
    }
    # What an installation brings is not ours to find.
    assert not {m for m in modules if m.split(".")[0] in FOLDERS and not exists(m)}


def test_every_option_that_a_page_gives_exists(page):
    ours = [
        w for w in commands(page.read_text()) if w[0].startswith("purerl.") and w[0].count(".") == 1
    ]
    # Another trainer's experiments need that trainer to be imported; a reader's own file is
    # executed with its options (tests/docs).
    files = [w[1] for w in ours if w[1:] and w[1].endswith(".py")]
    left = {file for file in files if "/peers/" in file or not (ROOT / file).exists()}
    ours = [w for w in ours if not left & set(w[1:2])]
    assert not {" ".join(w): unknown_options(w) for w in ours if unknown_options(w)}


def test_every_option_that_a_page_mentions_exists(page):
    mentioned = [code.split() for code in inline(page.read_text()) if code.startswith("--")]
    found = {word for words in mentioned for word in options(words) if "xla_" not in word}
    assert not {word for word in found if not re.search(rf"{re.escape(word)}\b", all_help())}


def test_every_path_that_a_page_names_exists(page):
    paths = {code for code in inline(page.read_text()) if looks_like_path(code)}
    assert not {path for path in paths if not (ROOT / path).exists()}


def test_every_link_of_a_page_leads_somewhere(page):
    for link in LINK.findall(FENCED.sub("", page.read_text())):
        if not link.startswith("http"):
            place, _, section = link.partition("#")
            target = page.parent / place if place else page
            assert target.exists(), link
            assert not section or section in sections(target), link


def test_python_blocks_import_the_front_door_alone(page):
    for block in blocks(page.read_text(), "python"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and node.module.startswith(OURS_BESIDE):
                continue
            if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] == "purerl":
                assert node.module == "purerl", node.module
                assert {alias.name for alias in node.names} <= set(purerl.__all__)
            if isinstance(node, ast.Import):
                assert not [a.name for a in node.names if a.name.startswith("purerl.")]
            if isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "purerl":
                assert node.attr in purerl.__all__


def test_readme_has_two_screens():
    lines = PAGES["README.md"].read_text().splitlines()
    assert len(lines) <= 120
    assert max(map(len, lines)) <= 100


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md"])
def test_every_room_is_in_the_map(name):
    text = PAGES[name].read_text()
    folders = [path.parent for path in (ROOT / "purerl").glob("*/__init__.py")]
    rooms = {folder.name for folder in folders if not folder.is_symlink()}
    assert len(rooms) >= 7
    assert not {room for room in rooms if not re.search(rf"^\| `(purerl/)?{room}/?`", text, re.M)}


def test_the_index_lists_every_page():
    index = PAGES["docs/README.md"]
    listed = {(index.parent / link).resolve() for link in LINK.findall(index.read_text())}
    assert {path.resolve() for path in (ROOT / "docs").rglob("*.md")} - {index} <= listed


def test_the_version_is_one():
    version = purerl.__version__
    assert f"\n## [{version}] - " in PAGES["CHANGELOG.md"].read_text()
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()


def test_every_version_says_what_bits_did():
    entries = re.split(r"^## ", PAGES["CHANGELOG.md"].read_text(), flags=re.MULTILINE)[1:]
    assert entries
    assert not [entry.splitlines()[0] for entry in entries if "\n**Bits:** " not in entry]
