"""Notebooks executed without Jupyter: cells in order, what they show kept as nbformat 4 outputs.

`python tests/support/notebooks.py scenes/fit_a_material.ipynb` executes a notebook and stores it with its outputs.
"""

import ast
import base64
import contextlib
import io
import json
import os
import sys
from pathlib import Path
from typing import Any


def execute(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """The notebook with the outputs of its code cells, and their variables; paths are relative to its folder."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    names: dict[str, Any] = {"__name__": "__main__"}
    before, count = Path.cwd(), 0
    os.chdir(path.parent)
    try:
        for cell in notebook["cells"]:
            if cell["cell_type"] == "code":
                count += 1
                cell["execution_count"], cell["outputs"] = count, _run("".join(cell["source"]), names, count)
    finally:
        os.chdir(before)
    return notebook, names


def _run(source: str, names: dict[str, Any], count: int) -> list[dict[str, Any]]:
    """Run a cell; its prints and its last expression as outputs."""
    tree = ast.parse(source)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    printed, value = io.StringIO(), None
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, f"<cell {count}>", "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), f"<cell {count}>", "eval"), names)
    outputs: list[dict[str, Any]] = []
    if printed.getvalue():
        outputs.append({"output_type": "stream", "name": "stdout", "text": printed.getvalue().splitlines(True)})
    if value is not None:
        result = {"output_type": "execute_result", "execution_count": count, "metadata": {}}
        outputs.append(result | {"data": _shown(value)})
    return outputs


def _shown(value: Any) -> dict[str, Any]:
    """A value by media type, as a notebook asks for it."""
    data: dict[str, Any] = {}
    if hasattr(value, "_repr_html_"):
        data["text/html"] = value._repr_html_().splitlines(True)
    if hasattr(value, "_repr_png_"):
        data["image/png"] = base64.b64encode(value._repr_png_()).decode()
    plain = repr(value) if not data else f"<{type(value).__module__}.{type(value).__qualname__}>"
    return data | {"text/plain": plain.splitlines(True)}


if __name__ == "__main__":
    for name in sys.argv[1:]:
        executed, _ = execute(Path(name).resolve())
        Path(name).write_text(json.dumps(executed, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
