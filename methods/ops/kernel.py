"""Calls from compiled forms of operations into the splat renderer's kernel, which contains them."""

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
"""Layers of networks are padded with units that are 0 to a multiple of it."""

_backend: ContextVar[str] = ContextVar("backend of compiled operations", default="cpu")


@contextmanager
def backend(name: str) -> Iterator[None]:
    """Use the variant of the kernel that a name in `instruction_sets` stands for; by default the fastest."""
    token = _backend.set(name)
    try:
        yield
    finally:
        _backend.reset(token)


def call(name: str, *arguments: Any) -> Any:
    """Call a function of the kernel with `arrays`. Results do not depend on the number of threads.

    What the kernel writes to has to be contiguous, as `empty_like` makes it.

    Raises
    ------
    ValueError
        An array's type, shape or layout is not what the function expects.
    """
    function = getattr(KERNEL.load(), name)
    return function(arrays(*arguments), instruction_sets()[_backend.get()], threads())


def arrays(*arguments: Any) -> tuple[Any, ...]:
    """Tensors as arrays, which reach the kernel faster than tensors do, and other arguments as they are."""
    return tuple(
        value.detach().contiguous().numpy() if isinstance(value, Tensor) else value for value in arguments
    )


def empty_like(values: Tensor) -> Tensor:
    """Memory for a result of this shape, contiguous whatever ``values`` are, as kernels need it."""
    return torch.empty_like(values, memory_format=torch.contiguous_format)


def pad_units(values: Tensor, *axes: int) -> Tensor:
    """Zeros after the end of the given axes, up to a multiple of `UNITS_STEP`."""
    widths = [0] * (2 * values.ndim)  # before and after, the last axis first
    for axis in axes:
        widths[-1 - 2 * axis] = -values.shape[axis] % UNITS_STEP
    return (pad(values, widths) if any(widths) else values).contiguous()
