"""Runs official CUDA code on a CPU: headbench's renderer replaces theirs, and stand-ins replace the rest.

The shim is installed in the interpreter before their scripts are run (`launch`). Their files are not modified. Results
have the label "(cpu-shim)", since they are not those of their rasteriser.
"""

from __future__ import annotations

import builtins
import importlib.util
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from types import ModuleType
from typing import Any

import numpy as np
import PIL.Image
import torch
import torch.utils.data
from scipy.spatial import KDTree
from torch import Tensor
from torch.overrides import TorchFunctionMode

from . import blended, blendshapes
from .blendshapes import OF_FLASHAVATAR, REPLACED, Silent


def install(threads: int, code: str) -> None:
    """Install the shim for everything that is imported later.

    ``code``: "bound splats", "blendshapes", "charted splats" or "blended splats", see `OfficialMethod.shimmed`. Packages that code imports
    optionally must stay missing, so stand-ins are limited to the required ones.
    """
    torch.set_num_threads(threads)
    own = blended.RASTERIZER if code == "blended splats" else {}
    _module("diff_gaussian_rasterization", blended.PUBLIC | blendshapes.RASTERIZER | own)
    _module("diff_gaussian_rasterization._C", blendshapes.RASTERIZER_KERNELS)
    _module("simple_knn")
    _module("simple_knn._C", {"distCUDA2": mean_square_distances, **blendshapes.NEIGHBOURS})
    packages = {
        "blendshapes": blendshapes.OF_BLENDSHAPES,
        "charted splats": {**blendshapes.OF_MESHES, **OF_FLASHAVATAR},
        "blended splats": blended.OF_BLENDED,
    }
    # Imported by scripts, but not used: no mesh is drawn, no external OBJ file read and no LPIPS measured.
    context = dict.fromkeys(("RasterizeCudaContext", "RasterizeGLContext"), Silent)
    unused: dict[str, dict[str, Any]] = {
        "nvdiffrast": {},
        "nvdiffrast.torch": context,
        "iopath": {},
        "iopath.common": {},
        "iopath.common.file_io": {"PathManager": LocalPaths},
        "torchvision": {},
        "torchvision.models": {},
        **packages.get(code, {}),
    }
    for name, content in unused.items():
        if not _is_installed(name):
            _module(name, content)
    for name, content in {"charted splats": REPLACED, "blended splats": blended.ALWAYS}.get(code, {}).items():
        _module(name, content)
    _without_cuda()
    _signed_images()


def mean_square_distances(points: Tensor) -> Tensor:
    """(N,) mean of the squared distances from each of (N, 3) points to its three nearest neighbours."""
    found, _ = KDTree(points.detach().numpy()).query(points.detach().numpy(), k=4)
    return torch.from_numpy(np.square(found[:, 1:]).mean(axis=1)).to(points.dtype)


def _is_installed(name: str) -> bool:
    """Whether a module is installed or already replaced by a stand-in."""
    package = name.partition(".")[0]
    if package == "torch":  # replaced by a module that imports another package
        package = name.rpartition(".")[2]
    known = sys.modules.get(package)
    if known is not None:
        return known.__spec__ is not None
    return importlib.util.find_spec(package) is not None


class LocalPaths:
    """``iopath``'s path manager for files of this machine."""

    def open(self, path: Any, mode: str = "r", **options: Any) -> Any:
        """Open a file."""
        return builtins.open(path, mode, **options)

    def exists(self, path: Any) -> bool:
        """Whether there is such a file."""
        return os.path.exists(path)


def _module(name: str, content: Mapping[str, Any] | None = None) -> None:
    module = ModuleType(name)
    module.__dict__.update(content or {})
    sys.modules[name] = module
    parent, _, child = name.rpartition(".")
    if parent:
        setattr(sys.modules[parent], child, module)


class OnCPU(TorchFunctionMode):
    """Replaces every CUDA device by the CPU."""

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Sequence[type],
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        kwargs = kwargs or {}
        if "device" in kwargs:
            kwargs = {**kwargs, "device": _on_cpu(kwargs["device"])}
        if func is Tensor.to:
            args = tuple(map(_on_cpu, args))
        return func(*args, **kwargs)


def _on_cpu(value: Any) -> Any:
    return "cpu" if isinstance(value, str | torch.device) and str(value).startswith("cuda") else value


class _Event(Silent):
    """A CUDA event that measures nothing."""

    def elapsed_time(self, other: Any) -> float:
        return 0.0


def _without_cuda() -> None:
    replaced: Any = torch.cuda
    for name in ("synchronize", "set_device", "empty_cache"):
        setattr(replaced, name, lambda *arguments, **options: None)
    replaced.Event, replaced.Stream, replaced.current_stream = _Event, Silent, Silent
    replaced.stream = lambda stream: nullcontext()
    pinned: Any = Tensor
    pinned.pin_memory = lambda self, *arguments, **options: self
    for of in (Tensor, torch.nn.Module):
        of.cuda = lambda self, *arguments, **options: self  # type: ignore[method-assign,union-attr,assignment]
    OnCPU().__enter__()  # active until the process ends
    stock: Any = torch.utils.data.DataLoader

    def loader(*arguments: Any, **options: Any) -> Any:
        # Workers decode images for a GPU; on a CPU they would take the cores from training.
        options |= {"num_workers": 0, "pin_memory": False, "persistent_workers": False}
        return stock(*arguments, **options)

    torch.utils.data.DataLoader = loader  # type: ignore[misc,assignment]


def _signed_images() -> None:
    stock: Any = PIL.Image.fromarray

    def fromarray(values: Any, *arguments: Any, **options: Any) -> Any:
        values = values.view(np.uint8) if getattr(values, "dtype", None) == np.int8 else values
        return stock(values, *arguments, **options)

    PIL.Image.fromarray = fromarray  # type: ignore[assignment]
