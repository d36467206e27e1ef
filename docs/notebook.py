"""Run the notebooks of the documentation, and store the outputs of their cells.

    python docs/notebook.py

A cell shows what it prints, its figures, and the value of its last line.
"""

from __future__ import annotations

import ast
import base64
import io
import json
import tempfile
from contextlib import chdir, redirect_stdout
from pathlib import Path
from typing import Any
from unittest import mock

import matplotlib as mpl
import matplotlib.pyplot as plt

DOCS = Path(__file__).resolve().parent
DPI = 80  # of the figures, dots per inch


def run(notebook: dict[str, Any]) -> dict[str, Any]:
    """Run the cells of a notebook in the current folder, and store their outputs.

    Returns:
        The variables of the cells.
    """
    variables: dict[str, Any] = {}
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    with mpl.rc_context({"backend": "agg"}):
        for number, cell in enumerate(cells, start=1):
            cell["execution_count"] = number
            cell["outputs"] = outputs_of("".join(cell["source"]), variables, number)
    return variables


def outputs_of(source: str, variables: dict[str, Any], number: int) -> list[dict[str, Any]]:
    """Run the source of a cell, and return its outputs in the format of notebooks."""
    outputs: list[dict[str, Any]] = []
    *statements, last = ast.parse(source).body
    if not isinstance(last, ast.Expr):
        statements.append(last)
    value = None

    printed = io.StringIO()
    with redirect_stdout(printed), mock.patch.object(plt, "show", return_value=None):
        exec(compile(ast.Module(statements, []), "cell", "exec"), variables)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "cell", "eval"), variables)

    if printed.getvalue():
        lines = printed.getvalue().splitlines(keepends=True)
        outputs.append({"name": "stdout", "output_type": "stream", "text": lines})
    for figure in map(plt.figure, plt.get_fignums()):
        data = {"image/png": png_of(figure), "text/plain": [repr(figure)]}
        outputs.append({"data": data, "metadata": {}, "output_type": "display_data"})
    plt.close("all")
    if value is not None:
        result = {"data": {"text/plain": repr(value).splitlines(keepends=True)}, "metadata": {}}
        outputs.append(result | {"execution_count": number, "output_type": "execute_result"})
    return outputs


def png_of(figure: Any) -> str:
    """Return a figure as PNG in base64."""
    file = io.BytesIO()
    figure.savefig(file, dpi=DPI, bbox_inches="tight")
    return base64.b64encode(file.getvalue()).decode("ascii")


def main() -> None:
    """Run all notebooks."""
    for path in sorted(DOCS.glob("*.ipynb")):
        notebook = json.loads(path.read_text(encoding="utf-8"))
        with tempfile.TemporaryDirectory() as folder, chdir(folder):
            run(notebook)
        path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
