"""Torch on one thread beside kernels on several."""

import pytest
import torch

from headbench.methods.shared.threads import threads, torch_on_one_thread, torch_threads


def nested():
    """Two levels, the outer one left by an error."""
    with torch_on_one_thread(True):
        with torch_on_one_thread(True):
            assert (torch.get_num_threads(), threads()) == (1, 3)
        assert (torch.get_num_threads(), threads()) == (1, 3)
        raise KeyError


def test_torch_on_one_thread_leaves_kernels_theirs():
    with torch_threads(3):
        with pytest.raises(KeyError):
            nested()
        assert (torch.get_num_threads(), threads()) == (3, 3)
        with torch_on_one_thread(False):
            assert (torch.get_num_threads(), threads()) == (3, 3)
