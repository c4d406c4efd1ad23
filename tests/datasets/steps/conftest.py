"""A capture, read once; its files are only read."""

from __future__ import annotations

import pytest

from headbench.datasets.ga.reader import read_capture


@pytest.fixture(scope="package")
def clip(pristine_capture):
    return read_capture(pristine_capture.union)
