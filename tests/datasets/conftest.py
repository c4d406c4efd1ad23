"""Fixtures for captures on disk."""

from __future__ import annotations

import shutil

import pytest

from .tiny_capture import TinyCapture, write_tiny_capture


@pytest.fixture(scope="session")
def pristine_capture(tmp_path_factory) -> TinyCapture:
    """A capture that tests only read."""
    return write_tiny_capture(tmp_path_factory.mktemp("capture"))


@pytest.fixture
def capture(pristine_capture, tmp_path) -> TinyCapture:
    """A copy of the capture that a test may damage."""
    root = tmp_path / "capture"
    shutil.copytree(pristine_capture.writer.root, root)
    return pristine_capture.moved(root)
