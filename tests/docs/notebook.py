"""Notebooks, executed: `python -m tests.docs.notebook FILE` writes what their cells print and draw.

Without Jupyter: cells are executed in one namespace, as the pages' blocks are.
"""

import ast
import base64
import contextlib
import io
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

Cell = dict[str, Any]


def execute(notebook: Cell) -> Cell:
    """Returns a notebook with the outputs of its code cells, executed in order in this folder."""
    names: dict[str, Any] = {"__name__": "__main__"}
    cells, number = [], 0
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            number += 1
            outputs = run_cell("".join(cell["source"]), names, number)
            cell = cell | {"execution_count": number, "outputs": outputs}
        cells.append(cell)
    return notebook | {"cells": cells}


def run_cell(source: str, names: dict[str, Any], number: int) -> list[Cell]:
    """Executes a cell; returns what it printed, the value of its last line, and its figures."""
    tree, said, last = ast.parse(source), io.StringIO(), None
    if isinstance(tree.body[-1], ast.Expr) and not source.rstrip().endswith(";"):
        last = ast.Expression(tree.body.pop().value)  # type: ignore[attr-defined]
    with contextlib.redirect_stdout(said):
        exec(compile(tree, f"cell {number}", "exec"), names)
        value = eval(compile(last, f"cell {number}", "eval"), names) if last else None
    outputs: list[Cell] = []
    if said.getvalue():
        text = said.getvalue().replace(str(Path.home()), "~")
        outputs.append({"output_type": "stream", "name": "stdout", "text": lines(text)})
    if value is not None:
        data = {"text/plain": lines(repr(value))}
        outputs.append(_result("execute_result", data) | {"execution_count": number})
    return outputs + [_result("display_data", {"image/png": x}) for x in figures()]


def lines(text: str) -> list[str]:
    return text.splitlines(keepends=True)


def figures() -> list[str]:
    """Returns matplotlib's open figures as PNGs in base64, and closes them."""
    pyplot = sys.modules.get("matplotlib.pyplot")
    found = []
    for number in pyplot.get_fignums() if pyplot else ():
        image = io.BytesIO()
        pyplot.figure(number).savefig(image, format="png", dpi=60, bbox_inches="tight")
        found.append(base64.b64encode(image.getvalue()).decode())
    if pyplot:
        pyplot.close("all")
    return found


def _result(kind: str, data: Cell) -> Cell:
    return {"output_type": kind, "data": data, "metadata": {}}


def main() -> None:
    path = Path(sys.argv[1]).resolve()
    os.environ.setdefault("MPLBACKEND", "agg")
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        done = execute(json.loads(path.read_text()))
    path.write_text(json.dumps(done, indent=1) + "\n")


if __name__ == "__main__":
    main()
