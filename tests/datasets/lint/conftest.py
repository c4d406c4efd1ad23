"""Fixtures of the linter's tests."""

from __future__ import annotations

import pytest

from .good_capture import GoodCapture, write_good_capture


@pytest.fixture(scope="session")
def pristine(tmp_path_factory) -> GoodCapture:
    """A capture without a fault, which tests only read."""
    return write_good_capture(tmp_path_factory.mktemp("good"))


@pytest.fixture
def good(pristine, tmp_path) -> GoodCapture:
    """A copy that a test may damage."""
    return pristine.copied(tmp_path / "good")
