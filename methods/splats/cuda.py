"""The CUDA backend: gsplat's kernels with the same interface, imported when first used.

gsplat (Apache-2.0, https://github.com/nerfstudio-project/gsplat) is the optional extra ``cuda``.
It is called through its functions for projection, tile lists and compositing instead of `rasterization`, so that
offsets of the 2D means are defined as here. Releases 1.5 and 1.6 are supported. Their wheels
contain sources: the extension is compiled when gsplat is first used on a machine, which takes minutes and needs the
CUDA toolkit. `prepare` does it before anything is timed. With ``antialiased``, 1.6 limits opacities to at least 0.5 %
of their value, whereas other backends let them go to 0.
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
from torch.nn.functional import pad

from ...bench.errors import UnavailableError, install_extra
from ...bench.machine import use_device
from ...bench.native.dispatch import is_cuda, is_float32, on_host
from .reference import published_radii
from .request import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN, Rendering, Request

log = logging.getLogger(__name__)

REMEDY = f"{install_extra('cuda')} (needs an NVIDIA GPU and the CUDA toolkit)."

CHANNELS = (1, 2, 3, 4, 5, 8, 9, 16, 17, 32)
"""Numbers of colour channels for which kernels are compiled in 1.5 and 1.6; other numbers are padded with zeros."""


@functools.cache
def installed() -> bool:
    """Whether there is a GPU and gsplat is installed, without importing it."""
    return torch.cuda.is_available() and importlib.util.find_spec("gsplat") is not None


def draws_or_warns(request: Request) -> bool:
    """Whether gsplat is available and supports this request; if a GPU cannot use it, log the reason and the remedy.

    Each reason is logged once per process.
    """
    if not supports(request):
        if is_float32(request.means) and not on_host(request.means):
            kind = str(request.means.device).split(":")[0]
            _warn_once(f"gsplat supports only NVIDIA GPUs, not device {kind!r}", "Draw on the CPU.")
        return False
    if not installed():
        _warn_once("gsplat is not installed", REMEDY)
        return False
    if not _exact(request):
        reason = "gsplat supports only the defaults of alpha_min and transmittance_min"
        _warn_once(reason, "Use the defaults, or draw on the CPU.")
        return False
    return True


@functools.cache
def _warn_once(reason: str, remedy: str) -> None:
    log.warning("On this GPU splats are drawn by the slow reference backend: %s. %s", reason, remedy)


def prepare(device: str) -> None:
    """Load gsplat if ``device`` is a CUDA device and it is installed; see `use_device`. Call it before timing."""
    use_device(device)
    if is_cuda(device) and installed():
        load()


@functools.cache
def load() -> ModuleType:
    """Import gsplat and its extension, which is compiled when first used on a machine."""
    if not torch.cuda.is_available():
        missing = "The renderer's backend 'cuda' needs a GPU, and torch finds none."
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
    except Exception as error:  # compilation can raise many types of errors
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
    """Lock against other headbench processes, since loading gsplat there would delete files being compiled."""
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
    """Folder of the CUDA toolkit with which torch compiles extensions; "" without nvcc."""
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
    """Render with gsplat; see `rasterize`. A required gradient of ``K`` is refused, since gsplat has none."""
    gsplat = load()
    if not _exact(request):
        expected = "alpha_min, transmittance_min: expected the defaults for backend 'cuda'"
        raise ValueError(f"{expected}, found {request.alpha_min!r}, {request.transmittance_min!r}.")
    if not supports(request):
        found = f"{request.means.dtype} on {request.means.device}"
        raise ValueError(f"means: expected torch.float32 on a CUDA device for backend 'cuda', found {found}.")
    if request.K.requires_grad:
        raise ValueError("K: expected no gradient to be required for backend 'cuda', found that it is.")
    warn_of_clamp(str(request.means.device))
    return draw(gsplat, request)


def draw(gsplat: Any, request: Request) -> Rendering:
    """Render ``request`` with gsplat's functions, given as a module."""
    columns, rows = -(-request.width // TILE), -(-request.height // TILE)
    radii, means2d, depths, conics, compensations = gsplat.fully_fused_projection(
        request.means,
        None,
        request.quats,
        request.scales,
        request.viewmat[None],
        request.K[None],
        request.width,
        request.height,
        eps2d=request.eps2d,
        near_plane=request.near,
        far_plane=request.far,
        calc_compensations=request.antialiased,
        opacities=request.opacities,
    )
    opacities = request.opacities[None]
    if request.antialiased:
        opacities = opacities * compensations
    if request.means2d_offset is not None:
        means2d = means2d + request.means2d_offset
    with torch.no_grad():
        # 1.6 skips tiles that intersect a splat's box but not its ellipse.
        parameters = inspect.signature(gsplat.isect_tiles).parameters
        ellipses = {"conics": conics, "opacities": opacities.contiguous()} if "conics" in parameters else {}
        _, keys, splats = gsplat.isect_tiles(means2d, radii, depths, TILE, columns, rows, **ellipses)
        offsets = gsplat.isect_offset_encode(keys, 1, columns, rows)
    channels = request.colors.shape[-1]
    padding = next(number for number in CHANNELS if number >= channels) - channels
    colors, background = request.colors, request.background
    if padding:
        colors, background = pad(colors, (0, padding)), pad(background, (0, padding))
    images, alphas = gsplat.rasterize_to_pixels(
        means2d,
        conics,
        colors[None],
        opacities,
        request.width,
        request.height,
        TILE,
        offsets,
        splats,
        backgrounds=background[None],
    )
    # gsplat's own radii depend on opacity and are 0 for splats too faint to be drawn.
    return Rendering(images[0, ..., :channels], alphas[0, ..., 0], lambda: published_radii(request))


@functools.cache
def warn_of_clamp(device: str) -> None:
    """Warn once if this gsplat clamps alpha at another value: 1.5 does at 0.999, a constant of its kernels.

    A splat with a transmittance of 1 % here has 0.1 % there. A pixel differs by at most 1 % of the range of colours,
    and does not differ if no splat's alpha is above 0.99.
    """
    highest = clamp_of(load(), device)
    if abs(highest - ALPHA_MAX) > 1e-4:
        log.warning(
            "This gsplat clamps alpha at %.4g, headbench's other backends at %.4g: pixels behind more opaque splats differ "
            "by up to %.2g of the range of colours. gsplat 1.6 clamps at the same value.",
            highest,
            ALPHA_MAX,
            1 - min(highest, ALPHA_MAX),
        )


def clamp_of(gsplat: Any, device: str) -> float:
    """Measure the maximum alpha of a splat of opacity 1."""
    one = torch.ones(1, device=device)
    request = Request(
        means=torch.tensor([[0.0, 0.0, 1.0]], device=device),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device),
        scales=torch.ones(1, 3, device=device),
        opacities=one,
        colors=one[None],
        viewmat=torch.eye(4, device=device),
        K=torch.tensor([[100.0, 0.0, 0.5], [0.0, 100.0, 0.5], [0.0, 0.0, 1.0]], device=device),
        background=torch.zeros(1, device=device),
        width=1,
        height=1,
    )
    return float(draw(gsplat, request).alpha[0, 0])
