from pathlib import Path

import pytest


@pytest.fixture
def toy(monkeypatch):
    """The toy plug-in, importable by name."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    import toy_plugin

    toy_plugin.FITS.clear()
    toy_plugin.ADAPTED.clear()
    toy_plugin.WORKLOAD_SIZES.clear()
    return toy_plugin
