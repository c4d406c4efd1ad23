"""The network of LPIPS: `Lpips`, its feature networks, and the location of their weights.

The feature networks are the convolutional parts of AlexNet (Krizhevsky, "One weird trick for parallelizing convolutional
neural networks", 2014), SqueezeNet 1.1 (Iandola et al., 2016) and VGG-16 (Simonyan, Zisserman, 2015, configuration D),
with torchvision's parameter names, so that its published weights load as they are.

The linear layers (version 0.1 of Zhang et al. 2018) come with the installed torchmetrics package, whose files
are read without importing it. The backbone is looked for, in this order:

1. an explicit path, a file or a folder;
2. the environment variable ``HEADBENCH_LPIPS_WEIGHTS``, a folder or a file; the file is ignored if it has the name of
   another network's weights;
3. the user's caches: headbench's own, then torch hub's;
4. PyTorch's published file, downloaded once into headbench's cache and checked against the hash in its name.

In a folder, the published file name, or the name of a file with only the convolutional part, is looked for.

Formats read:

- Weights of AlexNet, SqueezeNet and VGG-16 (`alexnet-owt-7be5be79.pth` and the like). Written by pytorch/vision. Not checked on
  a file of the program.
- Linear layers of LPIPS 0.1. Written by richzhang/PerceptualSimilarity. Checked on the files in torchmetrics' package, with the
  scores of the package lpips 0.1.4 for richzhang/PerceptualSimilarity@082bb24f `imgs`.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import os
import re
import shutil
import urllib.request
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from http.client import HTTPException
from itertools import groupby, islice
from pathlib import Path
from pickle import UnpicklingError
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from ..bench.contracts import ByteArray, FloatArray
from ..bench.errors import InputError, UnavailableError
from ..bench.io.arrays import check_numbers
from ..bench.io.files import atomic_path, cache_folder, digest, open_regular, reading
from .psnr import check_pair

EXPECTED = "a PyTorch file of weights"


def read_weights(path: Path, shapes: Mapping[str, tuple[int, ...]], entry: str = "") -> dict[str, Tensor]:
    """Read the tensors named in ``shapes`` as float32, on the CPU; ``entry`` names the dictionary in the file's dictionary."""
    with open_regular(path, EXPECTED) as stream, reading(path, EXPECTED):
        try:
            content = torch.load(stream, map_location="cpu", weights_only=True)
        except UnpicklingError as error:  # its message advises to load without weights_only
            name = re.search(r"GLOBAL (\S+)", str(error))
            found = f"the name {name[1]}, which no weights need" if name else "another pickle"
            raise InputError(path, "", EXPECTED, found) from error
    if entry and isinstance(content, dict):
        content = content.get(entry)
    if not isinstance(content, dict):
        found = "no such entry" if content is None else type(content).__name__
        raise InputError(path, entry, "a dictionary of tensors", found)
    return {name: _tensor(path, name, content.get(name), shape) for name, shape in shapes.items()}


Network = TypeVar("Network", bound=nn.Module)


def with_weights(network: Network, path: Path, entry: str = "") -> Network:
    """The network for inference with the weights of a file, see `read_weights`, whose names are those of its tensors."""
    state = network.state_dict()
    shapes = {name: tuple(value.shape) for name, value in state.items() if value.is_floating_point()}
    network.load_state_dict(state | read_weights(path, shapes, entry))
    return network.eval().requires_grad_(False)


def _tensor(path: Path, name: str, value: object, shape: tuple[int, ...]) -> Tensor:
    expected = f"a float tensor of shape {shape}"
    if value is None:
        raise InputError(path, name, expected, "no such entry", "Is it the file of another network?")
    if not isinstance(value, Tensor) or not value.is_floating_point():
        found = value.dtype if isinstance(value, Tensor) else type(value).__name__
        raise InputError(path, name, expected, str(found))
    if value.shape != shape:
        raise InputError(path, name, expected, f"shape {tuple(value.shape)}")
    with reading(path, expected, name):  # it may be sparse, or on the meta device
        numbers = value.detach().to(torch.float32).contiguous()
        check_numbers(path, name, numbers.numpy())
    return numbers


SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
EPSILON = 1e-10
VARIABLE = "HEADBENCH_LPIPS_WEIGHTS"
TIMEOUT_S = 5.0
NO_WEIGHTS = "LPIPS: weights missing, see headbench doctor"


class Lpips:
    """LPIPS with its weights loaded, ready to compare frames.

    - ``net``: "alex" (the usual choice for evaluation), "squeeze" or "vgg".
    - ``weights``: file of the backbone, or folder to look in; see the module for the default.
    - ``device``: device of the network, which always computes in float32.
    - ``scaled``: whether to scale images to [-1, 1], as the constants expect; False feeds [0, 1].
    - ``cache_mb``: maximum memory for cached features of ground-truth images, which the next method reuses, in 10^6 bytes.
    - ``fingerprint``: hex digest of all weights in use, the same for a full file and one with only the convolutional part.
    """

    def __init__(
        self,
        net: str = "alex",
        *,
        weights: Path | None = None,
        device: str = "cpu",
        scaled: bool = True,
        cache_mb: float = 256.0,
    ) -> None:
        if net not in NETWORKS:
            raise InputError("LPIPS", "net", f"one of {', '.join(NETWORKS)}", repr(net))
        self.spec = NETWORKS[net]
        self.scaled = scaled
        self._cache: dict[tuple[bytes, tuple[int, ...]], list[Tensor]] = {}
        self._cache_bytes, self._held = int(cache_mb * 1e6), 0
        backbone = load_backbone(self.spec, find_backbone(self.spec, weights))
        linear = load_linear(self.spec)
        self.fingerprint = digest(*(value.numpy() for value in (*backbone.values(), *linear)))
        self.device = torch.device(device)
        self._network = self.spec.build()
        self._network.load_state_dict(backbone)
        # Channels are interleaved (channels last); the network uses this memory layout as it is.
        self._network.requires_grad_(False).to(self.device)
        for parameter in self._network.parameters():
            if parameter.ndim == 4:
                parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
        self._linear = [value.to(self.device) for value in linear]
        self._shift = torch.tensor(SHIFT, device=self.device).view(1, 3, 1, 1)
        self._scale = torch.tensor(SCALE, device=self.device).view(1, 3, 1, 1)

    def __call__(self, image: ByteArray, target: ByteArray) -> float:
        """Distance of two (H, W, 3) 8-bit images, 0 for identical ones."""
        check_pair(image, target, self.spec.smallest)
        return float(self.distances(image[None], target[None])[0])

    def distances(self, images: ByteArray, targets: ByteArray) -> FloatArray:
        """(N,) float64 distances of two stacks (N, H, W, 3) of 8-bit images, in one pass."""
        if images.ndim != 4 or images.shape != targets.shape:
            found = f"{images.shape} and {targets.shape}"
            raise InputError("LPIPS", "images", "two stacks of one shape (N, H, W, 3)", found)
        if not len(images):
            return np.empty(0)
        check_pair(images[0], targets[0], self.spec.smallest)
        # Both stacks go through the network separately: half the peak memory, the same numbers.
        with torch.inference_mode():
            total = torch.zeros(len(images), dtype=torch.float64, device=self.device)
            layers = zip(self._features(images), self._target_features(targets), self._linear)
            for features, target_features, weight in layers:
                difference = features.sub_(target_features).square_()
                total += functional.conv2d(difference, weight).mean(dim=(1, 2, 3), dtype=torch.float64)
        return np.asarray(total.cpu().numpy())

    def batched(self, pairs: Iterable[tuple[ByteArray, ByteArray]], size: int = 8) -> Iterator[float]:
        """Distances of many pairs, in order, up to ``size`` of one image size at a time; ``pairs`` is read lazily."""
        for _, alike in groupby(pairs, key=lambda pair: (pair[0].shape, pair[1].shape)):
            while batch := list(islice(alike, size)):
                images, targets = zip(*batch)
                yield from map(float, self.distances(np.stack(images), np.stack(targets)))

    def _target_features(self, targets: ByteArray) -> list[Tensor]:
        """As `_features`, cached per frame, since every method is compared with the same ground truth."""
        places = [
            (hashlib.blake2b(np.ascontiguousarray(target), digest_size=16).digest(), target.shape)
            for target in targets
        ]
        if all(place in self._cache for place in places):
            return [torch.cat(layer) for layer in zip(*(self._cache[place] for place in places))]
        features = self._features(targets)
        for index, place in enumerate(places):
            layers = [layer[index : index + 1] for layer in features]
            size = sum(layer.numel() * layer.element_size() for layer in layers)
            # Once the cache is full, nothing is replaced: all methods use the same frame order, so that a new entry would be
            # evicted before its next use.
            if place not in self._cache and self._held + size <= self._cache_bytes:
                self._cache[place] = [layer.clone() for layer in layers]
                self._held += size
        return features

    def _features(self, images: ByteArray) -> list[Tensor]:
        """Unit-length features of each tapped layer, (N, C, h, w)."""
        # A copy: images of a clip may be read-only, or views of negative stride; tensors can be neither.
        x = torch.from_numpy(images.copy()).to(self.device)
        x = x.permute(0, 3, 1, 2).to(torch.float32)
        x = x / 127.5 - 1.0 if self.scaled else x / 255.0
        outputs = self._network(x.sub_(self._shift).div_(self._scale))
        return [out.div_(out.square().sum(dim=1, keepdim=True).sqrt_() + EPSILON) for out in outputs]


class Fire(nn.Module):
    """SqueezeNet's fire module: a 1 x 1 squeeze, then parallel 1 x 1 and 3 x 3 expansions."""

    def __init__(self, inputs: int, squeeze: int, expand: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeeze, 1)
        self.expand1x1 = nn.Conv2d(squeeze, expand, 1)
        self.expand3x3 = nn.Conv2d(squeeze, expand, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, inputs, H, W) to (N, 2 expand, H, W)."""
        x = torch.relu(self.squeeze(x))
        return torch.relu(torch.cat([self.expand1x1(x), self.expand3x3(x)], dim=1))


class TappedNetwork(nn.Module):
    """A chain of layers that also returns the outputs of some of them."""

    def __init__(self, layers: list[nn.Module], taps: tuple[int, ...]) -> None:
        super().__init__()
        self.features = nn.Sequential(*layers[: taps[-1] + 1])
        self.taps = taps

    def forward(self, x: Tensor) -> list[Tensor]:
        """Map (N, 3, H, W) to the output of each tapped layer, shallow to deep."""
        outputs: list[Tensor] = []
        for index, layer in enumerate(self.features):
            x = layer(x)
            if index in self.taps:
                outputs.append(x)
        return outputs


@dataclass(frozen=True)
class NetworkSpec:
    """A feature network of LPIPS and where its weights are published."""

    name: str  # as in `Lpips` and the file names of the linear layers
    channels: tuple[int, ...]  # of each tapped layer, shallow to deep
    smallest: int  # minimum height and width, pixels, for the deepest layer
    file: str  # published name; the part before the suffix is a prefix of the SHA-256
    features_file: str  # usual name of a file with only the convolutional part

    @property
    def url(self) -> str:
        """URL of the weights published by PyTorch."""
        return f"https://download.pytorch.org/models/{self.file}"

    def build(self) -> TappedNetwork:
        """Create the network with uninitialised weights."""
        return {"alex": _alexnet, "squeeze": _squeezenet, "vgg": _vgg16}[self.name]()


ALEX = NetworkSpec("alex", (64, 192, 384, 256, 256), 31, "alexnet-owt-7be5be79.pth", "alexnet_features.pth")
_SQUEEZE_FILES = "squeezenet1_1-b8a52dc0.pth", "squeezenet1_1_features.pth"
SQUEEZE = NetworkSpec("squeeze", (64, 128, 256, 384, 384, 512, 512), 17, *_SQUEEZE_FILES)
VGG = NetworkSpec("vgg", (64, 128, 256, 512, 512), 16, "vgg16-397923af.pth", "vgg16_features.pth")
NETWORKS = {spec.name: spec for spec in (ALEX, SQUEEZE, VGG)}


def _rectified(*sizes: int) -> list[nn.Module]:
    """A convolution (in channels, out channels, kernel size, stride, padding), then a ReLU."""
    return [nn.Conv2d(*sizes), nn.ReLU(inplace=True)]  # type: ignore[arg-type]


def _alexnet() -> TappedNetwork:
    layers = [
        *_rectified(3, 64, 11, 4, 2),
        nn.MaxPool2d(3, 2),
        *_rectified(64, 192, 5, 1, 2),
        nn.MaxPool2d(3, 2),
    ]
    for inputs, outputs in ((192, 384), (384, 256), (256, 256)):
        layers += _rectified(inputs, outputs, 3, 1, 1)
    return TappedNetwork(layers, (1, 4, 7, 9, 11))


def _squeezenet() -> TappedNetwork:
    layers = _rectified(3, 64, 3, 2)
    for fires in (
        [(64, 16, 64), (128, 16, 64)],
        [(128, 32, 128), (256, 32, 128)],
        [(256, 48, 192), (384, 48, 192), (384, 64, 256), (512, 64, 256)],
    ):
        layers += [nn.MaxPool2d(3, 2, ceil_mode=True), *(Fire(*sizes) for sizes in fires)]
    return TappedNetwork(layers, (1, 4, 7, 9, 10, 11, 12))


def _vgg16() -> TappedNetwork:
    layers: list[nn.Module] = []
    inputs = 3
    for block, (channels, repeats) in enumerate([(64, 2), (128, 2), (256, 3), (512, 3), (512, 3)]):
        layers += [nn.MaxPool2d(2, 2)] if block else []
        for _ in range(repeats):
            layers += _rectified(inputs, channels, 3, 1, 1)
            inputs = channels
    return TappedNetwork(layers, (3, 8, 15, 22, 29))


def present_backbone(spec: NetworkSpec, path: Path | None = None) -> Path | None:
    """The file with the weights of ``spec`` on this machine, or None; errors as for `find_backbone`."""
    if path is not None:
        return _named(spec, path, "weights")
    value = os.environ.get(VARIABLE)
    others = (other for other in NETWORKS.values() if other != spec)
    if value and Path(value).name not in {
        name for each in others for name in (each.file, each.features_file)
    }:
        return _named(spec, Path(value), f"environment variable {VARIABLE}")
    folders = (cache_folder(), Path(torch.hub.get_dir()) / "checkpoints")
    return next(filter(None, (_in_folder(spec, folder) for folder in folders)), None)


def find_backbone(spec: NetworkSpec, path: Path | None = None) -> Path:
    """Return the file with the weights of ``spec``, downloaded if necessary (see the module)."""
    if found := present_backbone(spec, path):
        return found
    target = cache_folder() / spec.file
    if problem := _fetch(spec.url, spec.file.removesuffix(".pth").rpartition("-")[2], target):
        raise UnavailableError(
            f"LPIPS needs the ImageNet weights of its {spec.name} network, which are not on this machine and "
            f"could not be fetched ({problem}).",
            f"Download {spec.url} elsewhere and put it into {cache_folder()}, or set {VARIABLE} to the file.",
            NO_WEIGHTS,
        )
    return target


def load_backbone(spec: NetworkSpec, path: Path) -> dict[str, Tensor]:
    """Read the convolutional part of a weights file, a full torchvision file or one with only this part."""
    return read_weights(path, {name: tuple(value.shape) for name, value in spec.build().state_dict().items()})


def load_linear(spec: NetworkSpec, path: Path | None = None) -> list[Tensor]:
    """Read the non-negative channel weights of each tapped layer, each (1, C, 1, 1) float32.

    ``path`` defaults to the file in the installed torchmetrics package.
    """
    if path is None:
        package = importlib.util.find_spec("torchmetrics")
        if package is None or not package.submodule_search_locations:
            raise UnavailableError(
                "LPIPS takes its linear layers from the package torchmetrics, which is not installed.",
                "Install it: pip install torchmetrics.",
            )
        folder = Path(package.submodule_search_locations[0]) / "functional" / "image" / "lpips_models"
        path = folder / f"{spec.name}.pth"
    shapes = {f"lin{i}.model.1.weight": (1, c, 1, 1) for i, c in enumerate(spec.channels)}
    return list(read_weights(path, shapes).values())


def _named(spec: NetworkSpec, path: Path, option: str) -> Path:
    if path.is_file():
        return path
    if found := _in_folder(spec, path):
        return found
    if path.is_dir():
        raise UnavailableError(
            f"LPIPS needs the ImageNet weights of its {spec.name} network; {option} names {path}, which has none.",
            f"Download {spec.url} and put it there.",
            NO_WEIGHTS,
        )
    expected = f"a file, or a folder with {spec.file} or {spec.features_file}"
    raise InputError(option, "", expected, f"{path}, not there")


def _in_folder(spec: NetworkSpec, folder: Path) -> Path | None:
    candidates = (folder / name for name in (spec.file, spec.features_file))
    return next((path for path in candidates if path.is_file()), None)


@functools.cache
def _fetch(url: str, sha256_prefix: str, target: Path) -> str:
    """Download ``url``; return the error, or "". Cached, so that an unreachable network is tried once."""
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
