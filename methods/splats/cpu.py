"""The compiled CPU backend: loading it, and the kernel as a differentiable torch function."""

from __future__ import annotations

import functools
import importlib
import logging
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ...bench.errors import UnavailableError
from .request import Rendering, Request

log = logging.getLogger(__name__)

REMEDY = "Install a C++17 compiler and reinstall headbench; the reference backend works meanwhile, slowly."


@functools.cache
def load() -> ModuleType | ImportError:
    """The kernel module, or why it cannot be imported."""
    try:
        return importlib.import_module("._kernel", __package__)
    except ImportError as error:
        return error


@functools.cache
def instruction_sets() -> dict[str, str]:
    """What the kernel can be run with here, by backend name, the fastest first; empty where it is missing."""
    module = load()
    if isinstance(module, ImportError):
        return {}
    available = module.instruction_sets()
    return {"cpu": available[0], **{f"cpu-{name}": name for name in available}}


def supports(request: Request) -> bool:
    """Tell whether the kernel takes this request's dtype and device."""
    return request.means.dtype == torch.float32 and request.means.device.type == "cpu"


@functools.cache
def usable_or_warn() -> bool:
    """Tell whether the kernel is there; if not, say why in one logged warning per process."""
    module = load()
    if isinstance(module, ImportError):
        log.warning("The splat kernel cannot be used (%s). %s", module, REMEDY)
        return False
    return True


def rasterize_cpu(request: Request, backend: str, threads: int | None) -> Rendering:
    """Render with the kernel; see `rasterize`."""
    if not supports(request):
        found = f"{request.means.dtype} on {request.means.device}"
        raise ValueError(f"means: expected torch.float32 on the CPU for backend {backend!r}, found {found}.")
    module, available = load(), instruction_sets()
    if isinstance(module, ImportError):
        raise UnavailableError(f"The renderer's backend {backend!r} is not available: {module}.", REMEDY)
    if backend not in available:
        names = ", ".join(map(repr, ("auto", *available, "reference")))
        raise ValueError(f"backend: expected one of {names} on this machine, found {backend!r}.")
    threads = torch.get_num_threads() if threads is None else threads
    if not isinstance(threads, int) or threads < 1:
        raise ValueError(f"threads: expected a positive integer or None, found {threads!r}.")
    offset = request.means2d_offset
    image, alpha, radii = _Rasterize.apply(
        *(request.means, request.quats, request.scales, request.opacities, request.colors),
        request.means.new_empty(0, 2) if offset is None else offset,
        *(request.background, request.viewmat, request.K),
        (request.near, request.far, request.eps2d),
        (request.height, request.width),
        available[backend],
        threads,
    )
    return Rendering(image, alpha, radii)


class _Rasterize(torch.autograd.Function):
    """The kernel's two passes. Arrays are handed over without copying where they are contiguous."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colors: Tensor,
        offset: Tensor,
        background: Tensor,
        viewmat: Tensor,
        K: Tensor,
        settings: tuple[float, float, float],
        size: tuple[int, int],
        instruction_set: str,
        threads: int,
    ) -> tuple[Tensor, Tensor, Tensor]:
        inputs = [
            value.contiguous() for value in (means, quats, scales, opacities, colors, offset, background)
        ]
        image = means.new_empty(*size, colors.shape[1])
        alpha = means.new_empty(*size)
        radii = torch.empty(len(means), dtype=torch.int32)
        ctx.frame = _kernel().forward(
            *_arrays(*inputs, viewmat.contiguous(), K.contiguous()),
            *settings,
            *_arrays(image, alpha, radii),
            instruction_set,
            threads,
        )
        ctx.threads = threads
        ctx.save_for_backward(*inputs)
        ctx.mark_non_differentiable(radii)
        return image, alpha, radii

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor, grad_alpha: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        # The kernel writes those of visible splats; culled ones have zero.
        gradients = [torch.zeros_like(value) for value in inputs]
        grad_viewmat = inputs[0].new_zeros(4, 4)
        _kernel().backward(
            ctx.frame,
            *_arrays(*inputs, grad_image.contiguous(), grad_alpha.contiguous()),
            *_arrays(*gradients, grad_viewmat),
            ctx.threads,
        )
        return (*gradients, grad_viewmat, None, None, None, None, None)


def peak_flops(backend: str) -> float:
    """Measured multiply-add rate of one thread in a backend's instruction set, floating-point operations a second."""
    return _kernel().peak_flops(instruction_sets()[backend])


def work(node: Any) -> tuple[int, int]:
    """Pairs of splat and pixel tested, and drawn, in the frame of an autograd node of the kernel."""
    return node.frame.work(*_arrays(*node.saved_tensors))


def _kernel() -> ModuleType:
    module = load()
    assert isinstance(module, ModuleType)
    return module


def _arrays(*tensors: Tensor) -> list[Any]:
    """The tensors' memory as numpy arrays, which reach the kernel faster than tensors do."""
    return [tensor.detach().numpy() for tensor in tensors]
