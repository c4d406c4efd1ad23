"""Requirements of native methods on the machine, for `MethodSpec.needs`."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from typing import Any

import torch

from ...bench.specs import Need
from ..splats import cpu, cuda


def splats(config: Any, device: str) -> Iterator[Need]:
    """The splat renderer: its kernel on CPUs, gsplat on GPUs."""
    if not device.startswith("cuda"):
        yield cpu.KERNEL.need()
        return
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else ""
    there = importlib.util.find_spec("gsplat") is not None
    slow = f"{cuda.REMEDY} The slow reference backend is used instead."
    yield Need("GPU", gpu, "PyTorch with CUDA, and an NVIDIA driver: https://pytorch.org/get-started.")
    yield Need("gsplat", "installed" if there else "", slow, required=False)
    if there and not cuda.compiled():
        yield Need("CUDA toolkit", cuda.toolkit(), cuda.toolkit_remedy())


def insta(config: Any, device: str) -> Iterator[Need]:
    """INSTA's kernel and its device."""
    from ..insta.kernel import KERNEL

    if not device.startswith("cpu"):
        yield Need(f"code for {device}", "", f"INSTA does not compute on {device!r}: run it with device=cpu.")
    yield KERNEL.need()
