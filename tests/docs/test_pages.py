"""Every code block of the pages is executed, or says why not."""

import ast
import re

import pytest

from tests.docs import __main__ as command_line
from tests.docs.blocks import EXECUTED, SHOWN, blocks, command, lone_markers, pages
from tests.docs.play import run

PAGES = pages()
RUN = [name for name, path in PAGES.items() if any(b.runs for b in blocks(path.read_text()))]
# Seconds each. The other pages take a quarter of an hour: they are executed each night, and by
# `.ci/run` where a change touches them.
EACH_TIME = ("README.md", "docs/explanation/bits.md", "docs/reference/run_folder.md")
EACH_TIME += tuple(f"docs/howto/{name}.md" for name in ("deploy", "look", "pandas", "record"))
INSTALLS = re.compile(r"pip install|git clone|apt-get")


@pytest.mark.parametrize("name", PAGES)
def test_every_block_is_told_how_to_run(name):
    text = PAGES[name].read_text()
    assert not lone_markers(text)
    for block in blocks(text):
        place = f"{name}:{block.line}"
        assert block.title or block.language in EXECUTED + SHOWN, f"{place}: {block.language!r}"
        assert block.marker != "run with" or block.language == "bash", f"{place}: only of bash"
        if block.language == "bash" and INSTALLS.search(block.code):
            assert block.marker == "not run", f"{place}: an installation is not run"
        if block.language == "python":
            ast.parse(block.code, place)


def too_wide(text):
    """Returns the lines of more than 100 characters that a writer could break, numbered from 1.

    Code, tables and comments are left out, and a line that is one long link.
    """
    lines = text.splitlines()
    code = set()
    for block in blocks(text):
        code |= set(range(block.line, block.line + len(block.code.splitlines())))
    return [
        number
        for number, line in enumerate(lines, 1)
        if len(line) > 100 and number not in code and not re.match(r" *(\||<!--|\S+$)", line)
    ]


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_wrapped_at_100_characters(name):
    assert not too_wide(PAGES[name].read_text())


def test_wide_lines_are_found_but_not_in_tables_and_code():
    wide = "word " * 25
    assert too_wide(f"short\n{wide}\n- {wide}\n") == [2, 3]
    assert not too_wide(f"| {wide} |\n<!-- {wide} -->\n\n```bash\n{wide}\n```\n")
    assert too_wide(f"```bash\n{wide}\n```\n{wide}\n") == [4]


def test_pages_that_are_executed_each_time_are_there():
    assert set(EACH_TIME) <= set(RUN)


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH_TIME)
def test_page_runs(name):
    done = run(PAGES[name])
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", [name for name in RUN if name not in EACH_TIME])
def test_page_runs_each_night(name):
    done = run(PAGES[name])
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]


def test_pages_whose_code_a_change_touches_are_found(monkeypatch):
    before = {name: path.read_text() for name, path in PAGES.items()}
    before["README.md"] = before["README.md"].replace("```python", "```python\n# other code")
    before["docs/howto/look.md"] += "\nOther words.\n"
    del before["docs/howto/record.md"]
    monkeypatch.setattr(command_line, "_page_at", lambda commit, name: before.get(name, ""))
    touched = [PAGES["README.md"], PAGES["docs/howto/record.md"]]
    assert command_line.changed_since("then") == touched


PAGE = """# A page

```python title="mine/own.py"
VALUE = 3
```

<!-- run with: world -->
```bash
mkdir -p there && cd there
python -c 'import sys; open("said", "w").write(sys.argv[1] + sys.argv[2])' "hello #1" \\
    all  # a comment
# and one more
```

- In a list

  <!-- not run: it fails -->
  ```bash
  exit 3
  ```

```python
import sys
from pathlib import Path
sys.path.append("..")
from mine.own import VALUE
said = Path("said").read_text()
```

```text
not code
```

```python
assert (VALUE, said) == (3, "hello #1all")
1 / LAST
```
"""


def test_blocks_are_read_with_their_markers():
    found = blocks(PAGE)
    assert [b.language for b in found] == ["python", "bash", "bash", "python", "text", "python"]
    assert [b.marker for b in found] == ["", "run with", "not run", "", "", ""]
    assert command(found[1]).endswith("    all world")
    assert found[2].code == "exit 3\n"
    assert found[0].title == "mine/own.py"


def test_a_marker_that_marks_nothing_is_found():
    good = "<!-- not run: it is long -->\n```bash\n```\n"
    assert not lone_markers(good)
    for bad in (good.replace("it is long ", ""), good.replace("\n", "\n\n", 1), good[:20] + "-->"):
        assert lone_markers(bad) == [1], bad


@pytest.mark.slow
def test_a_page_is_executed_in_order_and_stops_where_it_fails(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(PAGE.replace("LAST", "1"))
    assert run(page).returncode == 0
    page.write_text(PAGE.replace("LAST", "0"))
    done = run(page)
    assert done.returncode == 1
    assert f'page.md", line {PAGE[: PAGE.index("1 / LAST")].count(chr(10)) + 1}' in done.stderr
    page.write_text("```bash\nfalse\ntrue\n```\n")
    assert "line 2: exit code 1" in run(page).stderr
