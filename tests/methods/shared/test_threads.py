"""Torch on one thread beside kernels on several."""

import torch

from headbench.methods.shared.threads import threads, torch_on_one_thread, torch_threads


def test_torch_on_one_thread_leaves_kernels_theirs():
    with torch_threads(3):
        with torch_on_one_thread(True):
            assert (torch.get_num_threads(), threads()) == (1, 3)
            with torch_on_one_thread(True):
                assert (torch.get_num_threads(), threads()) == (1, 3)
            assert (torch.get_num_threads(), threads()) == (1, 3)
        assert (torch.get_num_threads(), threads()) == (3, 3)


def test_without_kernels_torch_keeps_its_threads():
    with torch_threads(3), torch_on_one_thread(False):
        assert (torch.get_num_threads(), threads()) == (3, 3)


def test_an_error_gives_torch_its_threads_back():
    with torch_threads(3):
        try:
            with torch_on_one_thread(True):
                raise KeyError
        except KeyError:
            pass
        assert (torch.get_num_threads(), threads()) == (3, 3)
