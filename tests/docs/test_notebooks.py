"""Notebooks are kept without outputs, and read nothing but what the repository has. `make docs` executes them."""

import json
import re
from pathlib import Path

import pytest

NOTEBOOKS = Path(__file__).parents[2] / "docs" / "notebooks"
PATHS = sorted(NOTEBOOKS.glob("*.ipynb"))


def test_three_notebooks_are_listed():
    listed = re.search(r"(?s):maxdepth: 1\n\n(.*?)\n```", (NOTEBOOKS / "index.md").read_text("utf-8"))[
        1
    ].split()
    assert sorted(listed) == [path.stem for path in PATHS]
    assert len(PATHS) == 3


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_a_notebook_is_stored_without_outputs(path):
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert code
    assert [cell["id"] for cell in code if cell["outputs"] or cell["execution_count"] is not None] == []
    assert not any("http" in "".join(cell["source"]) for cell in code)
