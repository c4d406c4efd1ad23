"""Fixtures of the linter's tests."""

from __future__ import annotations

import shutil

import pytest

from headbench.datasets.ga.writer import CaptureWriter

from .good_capture import GoodCapture, write_good_capture


@pytest.fixture(scope="session")
def pristine(tmp_path_factory) -> GoodCapture:
    """A capture without a fault, which tests only read."""
    return write_good_capture(tmp_path_factory.mktemp("good"))


@pytest.fixture
def good(pristine, tmp_path) -> GoodCapture:
    """A copy that a test may damage."""
    root = tmp_path / "good"
    shutil.copytree(pristine.writer.root, root)
    return GoodCapture(CaptureWriter(root, pristine.writer.plan))
