"""What the site needs beyond the pages of docs/: a hook of mkdocs (`mkdocs.yml`).

CONTRIBUTING.md, CHANGELOG.md and pages made from the code are pages too, and links lead to them
from the site as they do on GitHub. Code and the log of measurements are no part of it: a link to a
file there becomes the file's path. `<!-- docstring: NAME -->` becomes what the docstring of that
name says.
"""

import json
import posixpath
import re
import sys
from pathlib import Path
from typing import Any

import purerl

ROOT = Path(__file__).parent.parent.parent
sys.path.insert(0, str(ROOT))  # an installation has no `tests`

from tests.docs import generated  # noqa: E402

OUTSIDE = ("CONTRIBUTING.md", "CHANGELOG.md")
FENCED = re.compile(r"(^ *```.*?^ *```$)", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\((?!https?:|#|mailto:)([^)#\s]+)")
CODE = re.compile(r"\[([^\]]+)\]\((?:\.\./)*((?:lab|envs|experiments|purerl)/[^)#\s]*)[^)]*\)")
# What a link leads to on GitHub, and on the site.
MADE = {"tests/mistakes/table.toml": "reference/mistakes.md"}
DOCSTRING = re.compile(r"^<!-- docstring: (\w+) -->$", re.MULTILINE)
# Of a module's page only the names that users take from it.
MEMBERS = {
    "networks": "mlp MlpOptions recurrent RecurrentOptions from_linen",
    "lookup": "names find qpos_indices qvel_indices sensor_slice scale_action hash_model",
}


def on_files(files: Any, config: Any) -> Any:
    """Adds the pages that stand outside of docs/, and notebooks as pages."""
    from mkdocs.structure.files import File

    for name in OUTSIDE:
        files.append(File.generated(config, name, content=(ROOT / name).read_text()))
    for name, page in generated.OF_THE_SITE.items():
        files.append(File.generated(config, name, content=page()))
    for path in sorted((ROOT / "docs").rglob("*.ipynb")):
        name = path.relative_to(ROOT / "docs").with_suffix(".md").as_posix()
        files.append(File.generated(config, name, content=page_of_notebook(path.read_text())))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Makes links lead within the site, and puts docstrings where they are asked for."""
    name = page.file.src_uri
    here = name if name in OUTSIDE else f"docs/{name}"
    parts = FENCED.split(markdown)  # text, block, text, ...
    texts = (CODE.sub(lambda m: path_of(m[1], m[2]), text) for text in parts[::2])
    parts[::2] = [LINK.sub(lambda m: f"]({in_site(m[1], here)}", text) for text in texts]
    return DOCSTRING.sub(lambda m: docstring(m[1]), "".join(parts))


def path_of(text: str, path: str) -> str:
    """Returns a link's text with the path of a file that the site does not have."""
    return text if text == f"`{path}`" else f"{text} (`{path}`)"


def in_site(link: str, here: str) -> str:
    """Returns a link of the page `here` (its path in the clone) as a link of the site."""
    target = posixpath.normpath(posixpath.join(posixpath.dirname(here), link))
    target = MADE.get(target, target).removeprefix("docs/").removesuffix(".ipynb")
    if link.endswith(".ipynb"):
        target += ".md"
    return posixpath.relpath(target, posixpath.dirname(here.removeprefix("docs/")) or ".")


def docstring(name: str) -> str:
    """Returns mkdocstrings' block for a public name."""
    lines = [f"::: {purerl.HOMES[name]}.{name}", "    options:"]
    lines += [f"      heading: {'purerl.' + name}"]
    if name in MEMBERS:
        lines += [f"      members: [{', '.join(MEMBERS[name].split())}]"]
    return "\n".join(lines)


def page_of_notebook(text: str) -> str:
    """Returns a notebook as Markdown: its text, its code, and what that printed and drew."""
    parts = []
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        parts += [_shown(output) for output in cell["outputs"]]
    return "\n\n".join(parts) + "\n"


def _shown(output: Any) -> str:
    data = output.get("data", {})
    if "image/png" in data:
        return f"![]( data:image/png;base64,{''.join(data['image/png']).strip()})"
    said = "".join(output.get("text", data.get("text/plain", "")))
    return f"```text\n{said.rstrip()}\n```"
