"""The compiled CPU backend: loading it, and the kernel as a differentiable torch function."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ...bench.native.dispatch import is_float32, on_host
from ...bench.native.loader import Kernel
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
    none = request.means.new_empty(len(request.viewmats), 0, 2)
    image, alpha, radii = _Rasterize.apply(
        *(request.means, request.quats, request.scales, request.opacities, request.colors),
        none if request.means2d_offset is None else request.means2d_offset,
        none if request.means2d_abs is None else request.means2d_abs,
        *(request.backgrounds, request.viewmats, request.Ks),
        (request.near, request.far, request.eps2d, request.antialiased)
        + (request.alpha_min, request.transmittance_min),
        *((request.height, request.width), request.batched, available[backend], threads),
    )
    return request.rendering(image, alpha, lambda: radii)


class _Rasterize(torch.autograd.Function):
    """The kernel's two passes. Contiguous arrays are passed without copying.

    Cameras are drawn one after the other, each with all threads; the kernel adds their gradients in that order.
    """

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colors: Tensor,
        offset: Tensor,
        absolute: Tensor,
        backgrounds: Tensor,
        viewmats: Tensor,
        Ks: Tensor,
        settings: tuple[float, float, float, bool, float, float],
        size: tuple[int, int],
        batched: bool,
        instruction_set: str,
        threads: int,
    ) -> tuple[Tensor, Tensor, Tensor]:
        inputs = [
            value.contiguous() for value in (means, quats, scales, opacities, colors, offset, backgrounds)
        ]
        viewmats, Ks, views = viewmats.contiguous(), Ks.contiguous(), len(viewmats)
        images = means.new_empty(views, *size, colors.shape[-1])
        alphas = means.new_empty(views, *size)
        radii = torch.empty(views, len(means), dtype=torch.int32)
        ctx.frames = [
            KERNEL.load().forward(
                _of_view(inputs, view),
                (*_arrays(viewmats[view], Ks[view]), *settings),
                _arrays(images[view], alphas[view], radii[view]),
                instruction_set,
                threads,
            )
            for view in range(views)
        ]
        ctx.threads, ctx.absolute_like = threads, absolute.shape
        ctx.save_for_backward(*inputs)
        # Removing the axis of a single camera here avoids a copy of the gradient in autograd.
        ctx.mark_non_differentiable(radii)
        return (images, alphas, radii) if batched else (images[0], alphas[0], radii)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_images: Tensor, grad_alphas: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        views = len(ctx.frames)
        # The kernel adds to the gradients of drawn splats; those of others are zero.
        gradients = [torch.zeros_like(value) for value in inputs]
        grad_viewmats, grad_Ks = inputs[0].new_zeros(views, 4, 4), inputs[0].new_zeros(views, 3, 3)
        absolute = inputs[0].new_zeros(ctx.absolute_like) if ctx.needs_input_grad[_ABSOLUTE] else None
        grad_images = grad_images.contiguous().view(views, *grad_images.shape[-3:])
        grad_alphas = grad_alphas.contiguous().view(views, *grad_alphas.shape[-2:])
        for view, frame in enumerate(ctx.frames):
            KERNEL.load().backward(
                frame,
                _of_view(inputs, view),
                _arrays(grad_images[view], grad_alphas[view]),
                _of_view(gradients, view),
                _arrays(grad_viewmats[view], grad_Ks[view], None if absolute is None else absolute[view]),
                ctx.threads,
            )
        *of_splats, grad_backgrounds = gradients
        return (*of_splats, absolute, grad_backgrounds, grad_viewmats, grad_Ks, None, None, None, None, None)


_ABSOLUTE = 6  # position among the inputs


def _of_view(tensors: Sequence[Tensor], view: int) -> tuple[Any, ...]:
    """One camera's part of the inputs, in the kernel's order; colours may be common to all cameras, an empty offset is None."""
    *geometry, colors, offset, background = _arrays(*tensors)
    own = offset[view] if offset.size else None
    return (*geometry, colors[view] if colors.ndim == 3 else colors, own, background[view])


def peak_flops(backend: str) -> float:
    """Measured multiply-add rate of one thread in a backend's instruction set, floating-point operations per second."""
    return KERNEL.load().peak_flops(instruction_sets()[backend])


def work(node: Any) -> tuple[int, int]:
    """Number of splat-pixel pairs tested and drawn by the first camera of an autograd node of the kernel."""
    return node.frames[0].work(_of_view(node.saved_tensors, 0))


def stage_seconds(node: Any) -> dict[str, float]:
    """Processor time of the calling thread by stage, of the first camera of an autograd node of the kernel."""
    return node.frames[0].stage_seconds


def _arrays(*tensors: Tensor | None) -> tuple[Any, ...]:
    """The tensors' memory as numpy arrays, which are passed to the kernel faster."""
    return tuple(None if tensor is None else tensor.detach().numpy() for tensor in tensors)
