"""Calls of compiled operations in the splat renderer's kernel."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from ..shared.threads import threads
from ..splats.cpu import KERNEL, instruction_sets

UNITS_STEP = 16
"""Layers of networks are padded with zero units to a multiple of this."""
_backend: ContextVar[str] = ContextVar("backend of compiled operations", default="cpu")


@contextmanager
def backend(name: str) -> Iterator[None]:
    """Use the named variant of the kernel (see `instruction_sets`); by default the fastest."""
    token = _backend.set(name)
    try:
        yield
    finally:
        _backend.reset(token)


def call(name: str, *arguments: Any) -> Any:
    """Call a function of the kernel with `arrays`. Results do not depend on the number of threads.

    Output arrays must be contiguous, as those of `empty_like`.
    """
    function = getattr(KERNEL.load(), name)
    return function(arrays(*arguments), instruction_sets()[_backend.get()], threads())


def arrays(*arguments: Any) -> tuple[Any, ...]:
    """Tensors as arrays, which are passed to the kernel faster, and other arguments unchanged."""
    return tuple(
        value.detach().contiguous().numpy() if isinstance(value, Tensor) else value for value in arguments
    )


def empty_like(values: Tensor) -> Tensor:
    """Contiguous memory for a result of the shape of ``values``."""
    return torch.empty_like(values, memory_format=torch.contiguous_format)


def pad_units(values: Tensor, *axes: int) -> Tensor:
    """Zeros after the end of the given axes, up to a multiple of `UNITS_STEP`."""
    widths = [0] * (2 * values.ndim)  # before and after, the last axis first
    for axis in axes:
        widths[-1 - 2 * axis] = -values.shape[axis] % UNITS_STEP
    return (pad(values, widths) if any(widths) else values).contiguous()
