"""Fixtures for captures on disk."""

from __future__ import annotations

from pathlib import Path

import pytest

from .. import world
from .tiny_capture import TinyCapture


@pytest.fixture(scope="session")
def pristine_capture() -> TinyCapture:
    """A capture that tests only read."""
    return world.capture()


@pytest.fixture
def capture(pristine_capture, tmp_path) -> TinyCapture:
    """A copy of the capture that a test may damage."""
    return pristine_capture.copied(tmp_path / "capture")


@pytest.fixture
def plain_folder(pristine_capture, tmp_path, monkeypatch):
    """A folder with a capture in the layout of `plain_reader`, which is importable by its name."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    folder = tmp_path / "plain"
    folder.mkdir()
    (folder / "capture.plain").write_text(str(pristine_capture.union))
    return folder
