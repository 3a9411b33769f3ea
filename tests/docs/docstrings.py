"""An extension of griffe (`mkdocs.yml`): what a docstring shows by `>>>` is an example."""

import re
import textwrap
from typing import Any

import griffe

SHOWN = re.compile(r"^>>> .*?(?=\n\n|\Z)", re.MULTILINE | re.DOTALL)


class Examples(griffe.Extension):
    """Puts the heading `Examples:` before it, which docstrings of this style have."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Changes the docstring of whatever was loaded."""
        if obj.docstring:
            obj.docstring.value = with_heading(obj.docstring.value)


def with_heading(docstring: str) -> str:
    return SHOWN.sub(lambda m: "Examples:\n" + textwrap.indent(m[0], "    "), docstring)
