"""The notebooks of docs/gallery/ run from top to bottom and are stored without outputs; the site generates these."""

from __future__ import annotations

import ast
import json
import sys
import types
from pathlib import Path

import pytest

GALLERY = Path(__file__).parents[1] / "docs" / "gallery"
NOTEBOOKS = sorted(GALLERY.glob("*.ipynb"))


def cells(path: Path, kind: str) -> list[str]:
    return ["".join(cell["source"]) for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == kind]


def run(code: str, name: str, names: dict[str, object]) -> None:
    """As a notebook does: the value of the last expression is shown."""
    tree = ast.parse(code)
    last = tree.body[-1]
    if isinstance(last, ast.Expr):
        tree.body.pop()
    exec(compile(tree, name, "exec"), names)
    if isinstance(last, ast.Expr):
        value = eval(compile(ast.Expression(last.value), name, "eval"), names)
        assert value is None or len(repr(value)) < 5000
        if hasattr(value, "_repr_html_"):
            value._repr_html_()


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path, tmp_path, monkeypatch):
    pytest.importorskip("matplotlib", reason="notebooks draw")
    if path.stem == "stone-soup":
        pytest.importorskip("stonesoup", reason="Stone Soup is not installed: pip install 'sameas[stonesoup]'")
    monkeypatch.chdir(tmp_path)
    module = types.ModuleType("notebook")  # dataclasses resolve annotations there
    monkeypatch.setitem(sys.modules, "notebook", module)
    for number, code in enumerate(cells(path, "code")):
        run(code, f"{path.name}, cell {number}", vars(module))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_has_a_title_a_place_in_the_gallery_and_no_outputs(path):
    assert cells(path, "markdown")[0].startswith("# ")
    assert f"]({path.name})" in (GALLERY / "index.md").read_text()
    for cell in json.loads(path.read_text())["cells"]:
        assert not cell.get("outputs") and not cell.get("execution_count")


def test_the_gallery_lists_existing_notebooks_only():
    assert len(NOTEBOOKS) >= 6
    linked = [part.split(")")[0] for part in (GALLERY / "index.md").read_text().split("](")[1:]]
    assert sorted(name for name in linked if name.endswith(".ipynb")) == [path.name for path in NOTEBOOKS]
