"""The compiled CPU backend: loading, and the kernel as a differentiable torch function."""

from __future__ import annotations

import functools
import importlib
import logging
from types import ModuleType

import torch

from ...bench.errors import UnavailableError
from .request import Rendering, Request

log = logging.getLogger(__name__)

REMEDY = "Install a C++17 compiler and reinstall headbench; the reference backend works meanwhile, slowly."


@functools.cache
def load() -> ModuleType | ImportError:
    """The kernel module, or why it cannot be imported."""
    try:
        module = importlib.import_module("._kernel", __package__)
    except ImportError as error:
        return error
    if not hasattr(module, "forward"):
        return ImportError(f"{module.__file__} is of another version")
    return module


def names() -> tuple[str, ...]:
    """Backend names the kernel offers on this machine, the best first; none where it is missing."""
    module = load()
    return () if isinstance(module, ImportError) else ("cpu",)


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
    module = load()
    if isinstance(module, ImportError):
        raise UnavailableError(f"The renderer's backend {backend!r} is not available: {module}.", REMEDY)
    raise NotImplementedError
