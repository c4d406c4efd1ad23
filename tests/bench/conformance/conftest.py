import re
from pathlib import Path

import numpy as np
import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[2]


@pytest.fixture
def outside(monkeypatch, tmp_path):
    """A folder with plug-ins as their authors have it, importable by name: those of the pages and those beside this."""
    folder = tmp_path / "plugins"
    folder.mkdir()
    for path in HERE.glob("outside_*.py"):
        (folder / path.name).write_text(path.read_text())
    for page in ("tutorials/own-method", "howto/metric", "howto/report", "howto/experiment"):
        text = (ROOT / "docs" / f"{page}.md").read_text("utf-8")
        code = re.search(r"```python\n# (\w+\.py)\n(.*?)```", text, re.DOTALL)
        (folder / code[1]).write_text(code[2])
    monkeypatch.syspath_prepend(folder)
    for path in folder.iterdir():
        monkeypatch.delitem(__import__("sys").modules, path.stem, raising=False)
    return folder


@pytest.fixture
def npz_capture(tmp_path):
    """A capture in the layout of the outside reader, and the folder it is in."""
    folder = tmp_path / "captures"
    folder.mkdir()
    rng = np.random.default_rng(0)
    views = np.eye(4)[None].repeat(3, axis=0)
    views[:, 2, 3] = [1.0, 1.1, 1.2]
    np.savez(
        folder / "me.npz",
        images=rng.integers(0, 256, (4, 3, 12, 10, 3), dtype=np.uint8),
        intrinsics=np.array([[20.0, 0, 5], [0, 20, 6], [0, 0, 1]])[None].repeat(3, axis=0),
        world_to_camera=views,
        expressions=rng.normal(size=(4, 6)),
        vertices=rng.normal(size=(8, 3)) * 0.1,
        triangles=rng.integers(0, 8, (5, 3)),
    )
    return folder
