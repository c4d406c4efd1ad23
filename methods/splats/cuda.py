"""The CUDA backend: gsplat's kernels behind the same function, imported when first used.

gsplat (Apache-2.0, https://github.com/nerfstudio-project/gsplat) is an optional extra: ``pip install headbench[cuda]``.
It is driven through its functions for projection, tile lists and compositing instead of through its one big function, so
that offsets of the 2D means and absolute gradients come out as here.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import logging
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from ...bench.errors import UnavailableError
from .constants import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN
from .reference import published_radii
from .request import Rendering, Request

log = logging.getLogger(__name__)

REMEDY = "pip install 'headbench[cuda]', on a machine with an NVIDIA GPU and the CUDA toolkit."


@functools.cache
def usable() -> bool:
    """Whether there is a GPU and gsplat is installed, without importing it."""
    return torch.cuda.is_available() and importlib.util.find_spec("gsplat") is not None


def usable_or_warn(request: Request) -> bool:
    """Whether gsplat is there and draws this request; if a GPU is left without it, log why and what helps.

    It is logged once per process and reason.
    """
    if not supports(request):
        device = request.means.device.type
        if request.means.dtype == torch.float32 and device != "cpu":
            _warn_once(f"gsplat draws on NVIDIA GPUs alone, not on device {device!r}", "Draw on the CPU.")
        return False
    if not usable():
        _warn_once("gsplat is not installed", REMEDY)
        return False
    if not _exact(request):
        reason = "gsplat has no other cut-offs than the defaults of alpha_min and transmittance_min"
        _warn_once(reason, "Leave them at the defaults, or draw on the CPU.")
        return False
    return True


@functools.cache
def _warn_once(reason: str, remedy: str) -> None:
    log.warning("On this GPU splats are drawn by the slow reference backend: %s. %s", reason, remedy)


@functools.cache
def load() -> ModuleType:
    """Import gsplat. Raises `UnavailableError` where it or a GPU is missing."""
    if not torch.cuda.is_available():
        missing = "The renderer's backend 'cuda' needs a GPU that torch sees; there is none."
        raise UnavailableError(missing, REMEDY)
    try:
        return importlib.import_module("gsplat")
    except ImportError as error:
        raise UnavailableError(f"The renderer's backend 'cuda' needs gsplat: {error}.", REMEDY) from error


def supports(request: Request) -> bool:
    """Whether gsplat takes this request's dtype and device."""
    return request.means.dtype == torch.float32 and request.means.device.type == "cuda"


def _exact(request: Request) -> bool:
    """The cut-offs are those compiled into gsplat."""
    return (request.alpha_min, request.transmittance_min) == (ALPHA_MIN, TRANSMITTANCE_MIN)


def rasterize_cuda(request: Request) -> Rendering:
    """Render with gsplat; see `rasterize`. Gives no gradient of ``K``, as gsplat does not: refused, not dropped."""
    gsplat = load()
    if not _exact(request):
        expected = "alpha_min, transmittance_min: expected the defaults for backend 'cuda'"
        raise ValueError(f"{expected}, found {request.alpha_min!r}, {request.transmittance_min!r}.")
    if not supports(request):
        found = f"{request.means.dtype} on {request.means.device}"
        raise ValueError(f"means: expected torch.float32 on a CUDA device for backend 'cuda', found {found}.")
    if request.Ks.requires_grad:
        raise ValueError("K: expected no gradient to be required for backend 'cuda', found that it is.")
    warn_of_clamp(str(request.means.device))
    return draw(gsplat, request)


def draw(gsplat: Any, request: Request) -> Rendering:
    """Render ``request`` with a module that has gsplat's functions."""
    views, count = len(request.viewmats), len(request.means)
    columns, rows = -(-request.width // TILE), -(-request.height // TILE)
    radii, means2d, depths, conics, compensations = gsplat.fully_fused_projection(
        request.means,
        None,
        request.quats,
        request.scales,
        request.viewmats,
        request.Ks,
        request.width,
        request.height,
        eps2d=request.eps2d,
        near_plane=request.near,
        far_plane=request.far,
        calc_compensations=request.antialiased,
        opacities=request.opacities,
    )
    opacities = request.opacities.expand(views, count)
    if request.antialiased:
        opacities = opacities * compensations
    if request.means2d_offset is not None:
        means2d = means2d + request.means2d_offset
    collects = request.means2d_abs is not None and request.means2d_abs.requires_grad
    if collects:
        holder: list[Tensor] = []
        means2d = _TakeAbsolute.apply(means2d, request.means2d_abs, holder)
        holder.append(means2d)
    with torch.no_grad():
        _, keys, splats = gsplat.isect_tiles(means2d, radii, depths, TILE, columns, rows)
        offsets = gsplat.isect_offset_encode(keys, views, columns, rows)
    images, alphas = gsplat.rasterize_to_pixels(
        means2d,
        conics,
        request.colors.expand(views, count, -1),
        opacities,
        request.width,
        request.height,
        TILE,
        offsets,
        splats,
        backgrounds=request.backgrounds,
        absgrad=collects,
    )
    # gsplat's own radii are 0 for splats too faint to be drawn, and are cut to their opacity.
    return request.rendering(
        request.unstacked(images), request.unstacked(alphas.squeeze(-1)), lambda: published_radii(request)
    )


class _TakeAbsolute(torch.autograd.Function):
    """Pass the 2D means through; give a second input the absolute gradients gsplat leaves on them as an attribute."""

    @staticmethod
    def forward(ctx: Any, means2d: Tensor, absolute: Tensor, holder: list[Tensor]) -> Tensor:
        ctx.holder = holder
        return means2d.view_as(means2d)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        # Emptied, for the means hold this function and it would hold them.
        return gradient, ctx.holder.pop().absgrad, None


@functools.cache
def warn_of_clamp(device: str) -> None:
    """Warn once where this gsplat clamps alpha elsewhere than we do: some releases do at 0.999."""
    highest = clamp_of(load(), device)
    if abs(highest - ALPHA_MAX) > 1e-4:
        log.warning(
            "This gsplat clamps alpha at %.4g, headbench's other backends at %.4g: images differ behind and within "
            "splats more opaque than that.",
            highest,
            ALPHA_MAX,
        )


def clamp_of(gsplat: Any, device: str) -> float:
    """Measure the highest alpha one splat of opacity 1 reaches."""
    one = torch.ones(1, device=device)
    request = Request(
        means=torch.tensor([[0.0, 0.0, 1.0]], device=device),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device),
        scales=torch.ones(1, 3, device=device),
        opacities=one,
        colors=one[None],
        viewmats=torch.eye(4, device=device)[None],
        Ks=torch.tensor([[[100.0, 0.0, 0.5], [0.0, 100.0, 0.5], [0.0, 0.0, 1.0]]], device=device),
        backgrounds=torch.zeros(1, 1, device=device),
        width=1,
        height=1,
    )
    return float(draw(gsplat, request).alpha[0, 0])
