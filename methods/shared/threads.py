"""Number of threads of kernels and of torch."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch

_kernels: ContextVar[int | None] = ContextVar("threads of kernels", default=None)


def threads() -> int:
    """Number of kernel threads: that of torch, as set outside of `torch_on_one_thread`."""
    return _kernels.get() or torch.get_num_threads()


@contextmanager
def torch_on_one_thread(compiled: bool) -> Iterator[None]:
    """Run torch's own functions on the calling thread if ``compiled`` kernels do the long work on `threads`.

    Torch's threads spin while they wait, on the cores of the kernels' threads, and its results depend on their number.
    """
    before = torch.get_num_threads()
    if before == 1 or not compiled:
        yield
        return
    token = _kernels.set(before)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _kernels.reset(token)


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Run torch on ``count`` threads; with one, all its work is done by the timed thread."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
