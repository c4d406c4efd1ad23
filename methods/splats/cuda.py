"""The CUDA backend: gsplat's kernels behind the same function, imported when first used.

gsplat (Apache-2.0, https://github.com/nerfstudio-project/gsplat) is the optional extra ``cuda``.
It is driven through its functions for projection, tile lists and compositing instead of through its one big function, so
that offsets of the 2D means and absolute gradients come out as here. Releases 1.5 and 1.6 are known. Their wheels hold
sources: the extension is compiled when gsplat is first used on a machine, which takes minutes and needs the CUDA toolkit.
`prepare` does it before anything is timed. With ``antialiased``, 1.6 lets no opacity fall below 0.5 % of its value, where
the other backends let it go to 0.
"""

from __future__ import annotations

import fcntl
import functools
import importlib
import importlib.util
import inspect
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from ...bench.errors import UnavailableError, install_extra
from ...bench.machine import use_device
from ...bench.native.dispatch import is_cuda, is_float32, on_host
from .constants import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN
from .reference import published_radii
from .request import Rendering, Request

log = logging.getLogger(__name__)

REMEDY = f"{install_extra('cuda')} (needs an NVIDIA GPU and the CUDA toolkit)."

CHANNELS = (1, 2, 3, 4, 5, 8, 9, 16, 17, 32)
"""Colour channels that kernels are compiled for, in 1.5 and 1.6 alike; other numbers are filled up with zeros."""


@functools.cache
def installed() -> bool:
    """Whether there is a GPU and gsplat is installed, without importing it."""
    return torch.cuda.is_available() and importlib.util.find_spec("gsplat") is not None


def draws_or_warns(request: Request) -> bool:
    """Whether gsplat is there and draws this request; if a GPU is left without it, log why and what helps.

    It is logged once per process and reason.
    """
    if not supports(request):
        if is_float32(request.means) and not on_host(request.means):
            kind = str(request.means.device).split(":")[0]
            _warn_once(f"gsplat draws on NVIDIA GPUs alone, not on device {kind!r}", "Draw on the CPU.")
        return False
    if not installed():
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


def prepare(device: str) -> None:
    """Load gsplat if ``device`` is a CUDA device and it is installed; see `use_device`. Before anything is timed.

    Raises `UnavailableError` where gsplat's extension can neither be loaded nor compiled.
    """
    use_device(device)
    if is_cuda(device) and installed():
        load()


@functools.cache
def load() -> ModuleType:
    """Import gsplat and its extension, which is compiled where this machine has not done so before.

    Raises `UnavailableError` where gsplat, a GPU or the CUDA toolkit is missing, and where compiling fails.
    """
    if not torch.cuda.is_available():
        missing = "The renderer's backend 'cuda' needs a GPU that torch sees; there is none."
        raise UnavailableError(missing, REMEDY)
    if importlib.util.find_spec("gsplat") is None:
        raise UnavailableError("The renderer's backend 'cuda' needs gsplat; it is not installed.", REMEDY)
    if not compiled():
        log.info(
            "Loading gsplat; the first time on a machine it compiles its CUDA extension, which takes minutes."
        )
    try:
        with _one_process():
            gsplat = importlib.import_module("gsplat")
            extension = importlib.import_module("gsplat.cuda._backend")._C
    except Exception as error:  # the compiler's errors are of many kinds
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        raise UnavailableError(
            f"gsplat's CUDA extension cannot be loaded: {reason}.", toolkit_remedy()
        ) from error
    if extension is None:
        raise UnavailableError(
            "gsplat has to compile its CUDA extension; there is no nvcc.", toolkit_remedy()
        )
    return gsplat


@contextmanager
def _one_process() -> Iterator[None]:
    """Keep other processes of headbench from loading gsplat meanwhile, which removes what another one is compiling."""
    from torch.utils.cpp_extension import get_default_build_root

    root = Path(os.environ.get("TORCH_EXTENSIONS_DIR", get_default_build_root()))
    root.mkdir(parents=True, exist_ok=True)
    with open(root / "headbench-gsplat.lock", "w", encoding="ascii") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        yield


def compiled() -> bool:
    """Whether gsplat was installed with a compiled extension; it is not imported."""
    spec = importlib.util.find_spec("gsplat")
    folders = [] if spec is None else spec.submodule_search_locations or []
    return any(path.suffix in (".so", ".pyd") for folder in folders for path in Path(folder).glob("csrc.*"))


def toolkit() -> str:
    """Folder of the CUDA toolkit that torch compiles extensions with; "" where it has no nvcc."""
    from torch.utils.cpp_extension import CUDA_HOME

    return str(CUDA_HOME) if CUDA_HOME and (Path(CUDA_HOME) / "bin" / "nvcc").is_file() else ""


def toolkit_remedy() -> str:
    """How to install the tools that compile gsplat."""
    version = f" {torch.version.cuda}, with which torch was built," if torch.version.cuda else ""
    return f"Install the CUDA toolkit{version} (nvcc) and a C++ compiler, and set CUDA_HOME to the toolkit's folder."


def supports(request: Request) -> bool:
    """Whether gsplat takes this request's dtype and device."""
    return is_cuda(request.means.device) and is_float32(request.means)


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
        # 1.6 leaves out tiles that a splat's box meets and its ellipse does not.
        known = inspect.signature(gsplat.isect_tiles).parameters
        ellipses = {"conics": conics, "opacities": opacities.contiguous()} if "conics" in known else {}
        _, keys, splats = gsplat.isect_tiles(means2d, radii, depths, TILE, columns, rows, **ellipses)
        offsets = gsplat.isect_offset_encode(keys, views, columns, rows)
    channels = request.colors.shape[-1]
    padding = next(number for number in CHANNELS if number >= channels) - channels
    colors, backgrounds = request.colors, request.backgrounds
    if padding:
        colors, backgrounds = pad(colors, (0, padding)), pad(backgrounds, (0, padding))
    images, alphas = gsplat.rasterize_to_pixels(
        means2d,
        conics,
        colors.expand(views, count, -1),
        opacities,
        request.width,
        request.height,
        TILE,
        offsets,
        splats,
        backgrounds=backgrounds,
        absgrad=collects,
    )
    # gsplat's own radii are 0 for splats too faint to be drawn, and are cut to their opacity.
    return request.rendering(
        request.unstacked(images[..., :channels]),
        request.unstacked(alphas.squeeze(-1)),
        lambda: published_radii(request),
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
    """Warn once where this gsplat clamps alpha elsewhere than we do: 1.5 does at 0.999, a constant of its kernels.

    A splat that lets 1 % through here lets 0.1 % through there, and the next one of that kind is drawn, too. So a pixel
    differs by at most 1 % of the range of colours, and by nothing where no splat's alpha is above 0.99.
    """
    highest = clamp_of(load(), device)
    if abs(highest - ALPHA_MAX) > 1e-4:
        log.warning(
            "This gsplat clamps alpha at %.4g, headbench's other backends at %.4g: pixels behind more opaque splats differ "
            "by up to %.2g of the range of colours. gsplat 1.6 clamps where they do.",
            highest,
            ALPHA_MAX,
            1 - min(highest, ALPHA_MAX),
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
