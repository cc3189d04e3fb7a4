"""Notebooks run from top to bottom, and what they show has its picture."""

import ast
import json
from pathlib import Path
from typing import Any

import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "examples" / "notebooks").glob("*.ipynb"))


def shown_values(notebook: Path) -> list[Any]:
    """Execute the code cells, as Jupyter does, and return the values that it would show.

    What is executed is Python without Jupyter's own commands; a kernel would only add processes.
    """
    names: dict[str, Any] = {"__name__": "__main__"}
    values: list[Any] = []
    for number, cell in enumerate(json.loads(notebook.read_text(encoding="utf-8"))["cells"]):
        if cell["cell_type"] != "code":
            continue
        assert cell["outputs"] == [], "it is stored without outputs, which would be out of date"
        tree = ast.parse("".join(cell["source"]), f"{notebook.name}, cell {number}")
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, notebook.name, "exec"), names)  # noqa: S102 - our notebook
        if isinstance(last, ast.Expr):
            expression = compile(ast.Expression(last.value), notebook.name, "eval")
            values.append(eval(expression, names))  # noqa: S307 - our notebook
    return values


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda notebook: notebook.name)
def test_a_notebook_runs_and_shows_pictures(
    notebook: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(notebook.parent)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    values = shown_values(notebook)
    pages = {type(value).__name__: value._repr_html_() for value in values if _is_ours(value)}
    assert {"Recording", "Measurement", "Plan", "Comparison"} <= pages.keys()
    for name, page in pages.items():
        assert "<svg" in page or "data:image/png;base64," in page, f"{name} has no picture"
    for value in values:
        if _is_ours(value):
            assert "\n" not in repr(value)
            assert len(repr(value)) < 250


def _is_ours(value: object) -> bool:
    return type(value).__module__.startswith("chainshaper.")
