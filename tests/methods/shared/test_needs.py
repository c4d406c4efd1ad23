"""What methods need of a machine with a GPU, as `headbench doctor` tells."""

import importlib.util
from types import SimpleNamespace

import pytest

from headbench.methods.shared.method import splats
from headbench.methods.splats import cuda


@pytest.mark.parametrize(
    ("installed", "compiled", "toolkit", "missing"),
    [
        (False, False, "", {"gsplat"}),
        (True, False, "", {"CUDA toolkit"}),
        (True, False, "/usr/local/cuda", set()),
        (True, True, "", set()),
    ],
)
def test_gsplat_needs_a_toolkit_unless_it_is_compiled(monkeypatch, installed, compiled, toolkit, missing):
    found = SimpleNamespace() if installed else None
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: found)
    monkeypatch.setattr(cuda, "compiled", lambda: compiled)
    monkeypatch.setattr(cuda, "toolkit", lambda: toolkit)
    needs = [need for need in splats(None, "cuda:1") if need.what != "GPU"]
    assert {need.what for need in needs if not need.found} == missing
    assert all("nvcc" in need.remedy for need in needs if need.what == "CUDA toolkit")


def test_a_toolkit_has_the_compiler(monkeypatch, tmp_path):
    from torch.utils import cpp_extension

    monkeypatch.setattr(cpp_extension, "CUDA_HOME", str(tmp_path))
    assert cuda.toolkit() == ""
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "nvcc").touch()
    assert cuda.toolkit() == str(tmp_path)
