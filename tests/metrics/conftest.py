from pathlib import Path

import pytest
import torch

from headbench.metrics import lpips_network as weights
from headbench.metrics.lpips import _load


@pytest.fixture(autouse=True, scope="module")
def one_thread(one_torch_thread):
    """All of these tests have one thread."""


@pytest.fixture
def reference_folder():
    """Weights and reference scores of LPIPS, where they were put beside the repository."""
    folder = Path(__file__).parents[2].parent / "shared" / "data" / "lpips"
    if not folder.exists():
        pytest.skip("needs ../shared/data/lpips (LPIPS weights and check images), which is not there")
    return folder


@pytest.fixture
def bare_machine(tmp_path, monkeypatch):
    """No weights anywhere, no network, nothing remembered. Holds the URLs asked for."""
    asked = []

    def refuse(url, timeout):
        asked.append((url, timeout))
        raise OSError("the network is down")

    monkeypatch.delenv(weights.VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    monkeypatch.setattr("urllib.request.urlopen", refuse)
    weights._fetch.cache_clear()
    _load.cache_clear()
    yield asked
    weights._fetch.cache_clear()
    _load.cache_clear()
