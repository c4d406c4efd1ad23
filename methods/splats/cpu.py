"""The compiled CPU backend: loading it, and the kernel as a differentiable torch function."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ...bench.native.dispatch import Kernel, is_float32, on_host
from ..shared.threads import threads as kernel_threads
from .request import Rendering, Request

KERNEL = Kernel(
    "headbench.methods.splats._kernel",
    "The splat renderer's kernel",
    "the slow reference backend is used instead",
)


def instruction_sets() -> dict[str, str]:
    """Available instruction sets of the kernel, by backend name, the fastest first; empty if it is missing."""
    available = KERNEL.instruction_sets
    return {"cpu": available[0], **{f"cpu-{name}": name for name in available}} if available else {}


def supports(request: Request) -> bool:
    """Whether the kernel takes this request's dtype and device."""
    return on_host(request.means) and is_float32(request.means)


def rasterize_cpu(request: Request, backend: str, threads: int | None) -> Rendering:
    """Render with the kernel; see `rasterize`."""
    if not supports(request):
        found = f"{request.means.dtype} on {request.means.device}"
        raise ValueError(f"means: expected torch.float32 on the CPU for backend {backend!r}, found {found}.")
    KERNEL.load()
    available = instruction_sets()
    if backend not in available:
        names = ", ".join(map(repr, ("auto", *available, "reference")))
        raise ValueError(f"backend: expected one of {names} on this machine, found {backend!r}.")
    threads = kernel_threads() if threads is None else threads
    if not isinstance(threads, int) or threads < 1:
        raise ValueError(f"threads: expected a positive integer or None, found {threads!r}.")
    none = request.means.new_empty(0, 2)
    image, alpha, radii = _Rasterize.apply(
        *(request.means, request.quats, request.scales, request.opacities, request.colors),
        none if request.means2d_offset is None else request.means2d_offset,
        *(request.background, request.viewmat, request.K),
        (request.near, request.far, request.eps2d, request.antialiased)
        + (request.alpha_min, request.transmittance_min),
        *((request.height, request.width), available[backend], threads),
    )
    return Rendering(image, alpha, lambda: radii)


class _Rasterize(torch.autograd.Function):
    """The kernel's two passes. Contiguous arrays are passed without copying."""

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
        settings: tuple[float, float, float, bool, float, float],
        size: tuple[int, int],
        instruction_set: str,
        threads: int,
    ) -> tuple[Tensor, Tensor, Tensor]:
        inputs = [
            value.contiguous() for value in (means, quats, scales, opacities, colors, offset, background)
        ]
        image, alpha = means.new_empty(*size, colors.shape[-1]), means.new_empty(*size)
        radii = torch.empty(len(means), dtype=torch.int32)
        ctx.frame = KERNEL.load().forward(
            _in_order(inputs),
            (*_arrays(viewmat.contiguous(), K.contiguous()), *settings),
            _arrays(image, alpha, radii),
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
        # The kernel adds to the gradients of drawn splats; those of others are zero.
        gradients = [torch.zeros_like(value) for value in inputs]
        grad_viewmat, grad_K = inputs[0].new_zeros(4, 4), inputs[0].new_zeros(3, 3)
        KERNEL.load().backward(
            ctx.frame,
            _in_order(inputs),
            _arrays(grad_image.contiguous(), grad_alpha.contiguous()),
            _in_order(gradients),
            _arrays(grad_viewmat, grad_K),
            ctx.threads,
        )
        return (*gradients, grad_viewmat, grad_K, None, None, None, None)


def _in_order(tensors: Sequence[Tensor]) -> tuple[Any, ...]:
    """The inputs in the kernel's order; an empty offset is None."""
    *splats, offset, background = _arrays(*tensors)
    return (*splats, offset if offset.size else None, background)


def peak_flops(backend: str) -> float:
    """Measured multiply-add rate of one thread in a backend's instruction set, floating-point operations per second."""
    return KERNEL.load().peak_flops(instruction_sets()[backend])


def work(node: Any) -> tuple[int, int]:
    """Number of splat-pixel pairs tested and drawn by an autograd node of the kernel."""
    return node.frame.work(_in_order(node.saved_tensors))


def stage_seconds(node: Any) -> dict[str, float]:
    """Processor time of the calling thread by stage, of an autograd node of the kernel."""
    return node.frame.stage_seconds


def _arrays(*tensors: Tensor) -> tuple[Any, ...]:
    """The tensors' memory as numpy arrays, which are passed to the kernel faster."""
    return tuple(tensor.detach().numpy() for tensor in tensors)
