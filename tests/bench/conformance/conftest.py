import re
from pathlib import Path

import numpy as np
import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[2]


@pytest.fixture
def outside(monkeypatch, tmp_path):
    """A folder with plug-ins as their authors have it, importable by name: the README's method, a reader, metrics."""
    folder = tmp_path / "plugins"
    folder.mkdir()
    for name in ("outside_reader.py", "outside_metric.py"):
        (folder / name).write_text((HERE / name).read_text())
    code = re.search(r"```python\n(# grey\.py\n.*?)```", (ROOT / "README.md").read_text("utf-8"), re.DOTALL)
    (folder / "grey.py").write_text(code[1])
    monkeypatch.syspath_prepend(folder)
    for name in ("outside_reader", "outside_metric", "grey"):
        monkeypatch.delitem(__import__("sys").modules, name, raising=False)
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
