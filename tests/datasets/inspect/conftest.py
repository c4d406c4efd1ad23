"""A capture to inspect."""

import pytest
import torch

from headbench.datasets.ga.reader import read_capture

from ..lint.good_capture import write_good_capture


@pytest.fixture(scope="session")
def capture(tmp_path_factory):
    """Written once, only read."""
    torch.set_num_threads(1)
    return write_good_capture(tmp_path_factory.mktemp("inspected"))


@pytest.fixture(scope="session")
def clip(capture):
    return read_capture(capture.union)
