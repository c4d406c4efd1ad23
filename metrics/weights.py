"""Finds, fetches and checks the weights of LPIPS: a backbone from ImageNet training, and the linear layers.

The linear layers (version 0.1 of Zhang et al. 2018) come with the installed torchmetrics package, whose files
are read without importing it. The backbone is looked for, in this order:

1. an explicit path, a file or a folder;
2. the environment variable ``HEADBENCH_LPIPS_WEIGHTS``, a file or a folder;
3. the user's caches: headbench's own, then torch hub's;
4. PyTorch's publication, fetched once into headbench's cache and checked against the hash in its name.

In a folder, the published file name or that of a file with the convolutional part alone is looked for.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import os
import shutil
import urllib.request
from collections.abc import Mapping
from http.client import HTTPException
from pathlib import Path

import torch
from torch import Tensor

from ..bench.errors import InputError, UnavailableError
from ..bench.io.files import atomic_path, cache_folder
from .networks import NETWORKS, NetworkSpec
from .torch_file import read_weights

VARIABLE = "HEADBENCH_LPIPS_WEIGHTS"
TIMEOUT_S = 5.0


def find_backbone(spec: NetworkSpec, path: Path | None = None) -> Path:
    """Return the file with the weights of ``spec``, fetched if need be (see the module).

    Raises
    ------
    InputError : ``path`` or the environment variable names something that is not there.
    UnavailableError : not in the folder named, or not found anywhere and not to be fetched; says how to mend it.
    """
    if path is not None:
        return _named(spec, path, "weights")
    if value := os.environ.get(VARIABLE):
        return _named(spec, Path(value), f"environment variable {VARIABLE}")
    for folder in (cache_folder(), Path(torch.hub.get_dir()) / "checkpoints"):
        if found := _in_folder(spec, folder):
            return found
    target = cache_folder() / spec.file
    if problem := _fetch(spec.url, spec.sha256_prefix, target):
        raise UnavailableError(
            f"LPIPS needs the ImageNet weights of its {spec.name} network, which are not on this machine and "
            f"could not be fetched ({problem}).",
            f"Download {spec.url} elsewhere and put it into {cache_folder()}, or set {VARIABLE} to the file.",
        )
    return target


def load_backbone(spec: NetworkSpec, path: Path) -> dict[str, Tensor]:
    """Read the convolutional part of a weights file: a full torchvision one, or one of features alone.

    Raises `InputError` for a file that is none, lacks a parameter, or has one of another shape or not finite.
    """
    return _read(path, {name: tuple(value.shape) for name, value in spec.build().state_dict().items()})


def load_linear(spec: NetworkSpec, path: Path | None = None) -> list[Tensor]:
    """Read the non-negative channel weights of each tapped layer, each (1, C, 1, 1) float32.

    ``path`` defaults to the file in the installed torchmetrics package.
    """
    path = _torchmetrics_folder() / f"{spec.name}.pth" if path is None else path
    shapes = {f"lin{i}.model.1.weight": (1, c, 1, 1) for i, c in enumerate(spec.channels)}
    return list(_read(path, shapes).values())


def network_spec(name: str) -> NetworkSpec:
    """Look up a network by name. Raises `InputError` for an unknown one."""
    if name not in NETWORKS:
        raise InputError("LPIPS", "net", f"one of {', '.join(NETWORKS)}", repr(name))
    return NETWORKS[name]


def _named(spec: NetworkSpec, path: Path, option: str) -> Path:
    if path.is_file():
        return path
    if found := _in_folder(spec, path):
        return found
    if path.is_dir():
        raise UnavailableError(
            f"LPIPS needs the ImageNet weights of its {spec.name} network; {option} names {path}, which has none.",
            f"Download {spec.url} and put it there.",
        )
    raise InputError(
        option, "", f"a file, or a folder with {spec.file} or {spec.features_file}", f"{path}, not there"
    )


def _in_folder(spec: NetworkSpec, folder: Path) -> Path | None:
    candidates = (folder / name for name in (spec.file, spec.features_file))
    return next((path for path in candidates if path.is_file()), None)


@functools.cache
def _fetch(url: str, sha256_prefix: str, target: Path) -> str:
    """Fetch ``url``; return what went wrong, or "". Remembered, so that a dead network is waited for once."""
    try:
        with urllib.request.urlopen(url, timeout=TIMEOUT_S) as response, atomic_path(target) as temporary:
            with temporary.open("wb") as stream:
                shutil.copyfileobj(response, stream, 1 << 20)
            with temporary.open("rb") as stream:
                digest = hashlib.file_digest(stream, "sha256")
            if not digest.hexdigest().startswith(sha256_prefix):
                raise OSError(f"its SHA-256 is {digest.hexdigest()}, not {sha256_prefix}...")
    except (OSError, HTTPException) as error:
        return f"{url}: {error}"
    return ""


def _torchmetrics_folder() -> Path:
    package = importlib.util.find_spec("torchmetrics")
    if package is None or not package.submodule_search_locations:
        raise UnavailableError(
            "LPIPS takes its linear layers from the package torchmetrics, which is not installed.",
            "Install it: pip install torchmetrics.",
        )
    return Path(package.submodule_search_locations[0]) / "functional" / "image" / "lpips_models"


def _read(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Tensor]:
    found = read_weights(path, shapes)
    return {name: torch.from_numpy(values).to(torch.float32) for name, values in found.items()}
