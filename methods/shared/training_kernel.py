"""What training computes beside the rasteriser, by the compiled kernel with gradients in closed form.

Each function names its reference implementation in torch, which is the definition, takes float64, and is used where the
kernel is not: other devices, other dtypes, or no compiler at installation. The kernel's results do not depend on the number
of threads.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from . import device_frame, losses
from .avatar_kernel import call, splats_to_world, triangles, usable
from .binding import Frames, WorldSplats
from .binding import to_world as reference_to_world
from .binding import triangle_frames as reference_triangle_frames
from .networks import coefficient_count, sh_to_rgb


def photometric_loss(image: Tensor, truth: Tensor, ssim_weight: float, backend: str = "cpu") -> Tensor:
    """Compiled form of `losses.photometric_loss`; only ``image`` receives a gradient."""
    if not usable(image):
        return losses.photometric_loss(image, truth, ssim_weight)
    return _Photometric.apply(image, truth, ssim_weight, backend)  # type: ignore[no-untyped-call]


class _Photometric(torch.autograd.Function):
    """Loss and gradient come of one sweep over the image."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, truth: Tensor, ssim_weight: float, backend: str) -> Tensor:
        gradient = torch.empty_like(image)
        loss = call(
            "photometric",
            image,
            truth,
            losses.window_weights(),
            float(ssim_weight),
            gradient,
            backend=backend,
        )
        ctx.save_for_backward(gradient)
        return image.new_tensor(loss)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return (gradient if grad == 1 else gradient * grad), None, None, None


def triangle_frames(vertices: Tensor, faces: Tensor, backend: str = "cpu") -> Frames:
    """Compiled form of `binding.triangle_frames`."""
    if not usable(vertices):
        return reference_triangle_frames(vertices, faces)
    return Frames(*_TriangleFrames.apply(vertices, faces, backend))  # type: ignore[no-untyped-call]


class _TriangleFrames(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, vertices: Tensor, faces: Tensor, backend: str) -> tuple[Tensor, ...]:
        ctx.save_for_backward(vertices, faces)
        ctx.backend = backend
        return tuple(triangles(vertices, faces, backend))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        vertices, faces = ctx.saved_tensors
        by_vertices = torch.empty_like(vertices)
        call("triangles_backward", vertices, faces, *grads, by_vertices, backend=ctx.backend)
        return by_vertices, None, None


def to_world(
    frames: Frames, binding: Tensor, means: Tensor, log_scales: Tensor, quats: Tensor, backend: str = "cpu"
) -> WorldSplats:
    """Compiled form of `binding.to_world`."""
    if not usable(means):
        return reference_to_world(frames, binding, means, log_scales, quats)
    return WorldSplats(*_ToWorld.apply(*frames, means, log_scales, quats, binding, backend))  # type: ignore[no-untyped-call]


class _ToWorld(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        rotation: Tensor,
        center: Tensor,
        size: Tensor,
        quaternion: Tensor,
        means: Tensor,
        log_scales: Tensor,
        quats: Tensor,
        binding: Tensor,
        backend: str,
    ) -> tuple[Tensor, ...]:
        scales, unit_quats = torch.empty_like(log_scales), torch.empty_like(quats)
        call("activate", log_scales, quats, scales, unit_quats, backend=backend)
        frames = Frames(rotation, center, size, quaternion)
        ctx.save_for_backward(binding, *frames, means, quats, scales)
        ctx.backend = backend
        return tuple(splats_to_world(frames, binding, means, unit_quats, scales, backend))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        binding, *frames, means, quats, scales = ctx.saved_tensors
        wanted = any(ctx.needs_input_grad[:4])
        by_frames = [
            torch.empty_like(value) if wanted else value.new_empty(0, *value.shape[1:]) for value in frames
        ]
        by_means, by_quats, by_log_scales = (torch.empty_like(value) for value in (means, quats, scales))
        call(
            *("to_world_backward", binding, *frames, means, quats, scales, grads[0], grads[1], grads[2]),
            *(by_means, by_quats, by_log_scales, *by_frames),
            backend=ctx.backend,
        )
        return *(by_frames if wanted else [None] * 4), by_means, by_log_scales, by_quats, None, None


def harmonic_colors(dc: Tensor, rest: Tensor, vectors: Tensor, degree: int, backend: str = "cpu") -> Tensor:
    """Compiled form of `networks.sh_to_rgb`; (N, 3) vectors from the camera to the splats may have any length."""
    if not usable(dc):
        directions = torch.nn.functional.normalize(vectors, dim=1)
        if dc.device.type == "cpu":
            return sh_to_rgb(dc, rest, directions, degree)
        rest = rest[:, :, : coefficient_count(degree) - 1]
        return device_frame.shade(device_frame.coefficients_of(dc, rest), directions)
    return _HarmonicColors.apply(dc, rest, vectors, degree, backend)  # type: ignore[no-untyped-call]


class _HarmonicColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, dc: Tensor, rest: Tensor, vectors: Tensor, degree: int, backend: str) -> Tensor:
        colors = torch.empty_like(dc)
        call("harmonics", degree, dc, rest, vectors, colors, backend=backend)
        ctx.save_for_backward(dc, rest, vectors, colors)
        ctx.degree, ctx.backend = degree, backend
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        dc, rest, vectors, colors = ctx.saved_tensors
        gradients = torch.empty_like(dc), torch.empty_like(rest), torch.empty_like(vectors)
        call(
            *("harmonics_backward", ctx.degree, dc, rest, vectors, colors, grad, *gradients),
            backend=ctx.backend,
        )
        return *gradients, None, None
