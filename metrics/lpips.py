"""Learned perceptual image patch similarity of one frame.

Zhang, Isola, Efros, Shechtman, Wang, "The unreasonable effectiveness of deep features as a perceptual metric",
CVPR 2018, equation 1, version 0.1 (with the scaling layer). Inputs are brought to [-1, 1], as the scaling
layer's constants expect. Feeding [0, 1] instead, as some published avatar code does, gives lower numbers; the
two do not compare. `Lpips` can do both, under names that tell them apart.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ..bench.contracts import ByteArray, FloatArray
from ..bench.errors import InputError, UnavailableError
from ..bench.io.files import digest
from .pairs import check_pair
from .weights import find_backbone, load_backbone, load_linear, network_spec

SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
EPSILON = 1e-10


class Lpips:
    """LPIPS with its weights loaded, ready to compare frames.

    Parameters
    ----------
    net : "alex" (customary for reporting), "squeeze" or "vgg".
    weights : file with the backbone, or folder to look in; see `headbench.metrics.weights` for the default.
    device : where the network runs; always in float32.
    scaled : bring images to [-1, 1], as the constants expect; False feeds [0, 1].
    cache_mb : bound of the features of truths that are kept for the next method, in 10^6 bytes.

    Attributes
    ----------
    fingerprint : hex digest of all weights in use, the same for a full file and one of features alone.

    Raises
    ------
    UnavailableError : no weights; says how to get them.
    InputError : weights that are not those of the network.
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
        self.spec = network_spec(net)
        self.scaled = scaled
        self._cache: dict[tuple[bytes, tuple[int, ...]], list[Tensor]] = {}
        self._cache_bytes, self._held = int(cache_mb * 1e6), 0
        backbone = load_backbone(self.spec, find_backbone(self.spec, weights))
        linear = load_linear(self.spec)
        self.fingerprint = digest(*(value.numpy() for value in (*backbone.values(), *linear)))
        self.device = torch.device(device)
        self._network = self.spec.build()
        self._network.load_state_dict(backbone)
        # Pixels come channel by channel side by side; the network takes them as they lie.
        self._network.requires_grad_(False).to(self.device)
        for parameter in self._network.parameters():
            if parameter.ndim == 4:
                parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
        self._linear = [value.to(self.device) for value in linear]
        self._shift = torch.tensor(SHIFT, device=self.device).view(1, 3, 1, 1)
        self._scale = torch.tensor(SCALE, device=self.device).view(1, 3, 1, 1)

    def __call__(self, image: ByteArray, truth: ByteArray) -> float:
        """Distance of two (H, W, 3) 8-bit images, 0 for identical ones."""
        check_pair(image, truth, self.spec.smallest)
        return float(self.distances(image[None], truth[None])[0])

    def distances(self, images: ByteArray, truths: ByteArray) -> FloatArray:
        """(N,) float64 distances of two stacks (N, H, W, 3) of 8-bit images, in one pass."""
        if images.ndim != 4 or images.shape != truths.shape:
            found = f"{images.shape} and {truths.shape}"
            raise InputError("LPIPS", "images", "two stacks of one shape (N, H, W, 3)", found)
        if not len(images):
            return np.empty(0)
        check_pair(images[0], truths[0], self.spec.smallest)
        # Both stacks go through the network separately: half the peak memory, the same numbers.
        with torch.inference_mode():
            total = torch.zeros(len(images), dtype=torch.float64, device=self.device)
            layers = zip(self._features(images), self._true_features(truths), self._linear)
            for features, true_features, weight in layers:
                difference = features.sub_(true_features).square_()
                total += functional.conv2d(difference, weight).mean(dim=(1, 2, 3), dtype=torch.float64)
        return np.asarray(total.cpu().numpy())

    def batched(self, pairs: Iterable[tuple[ByteArray, ByteArray]], size: int = 8) -> Iterator[float]:
        """Distances of many pairs of one size, in order, ``size`` at a time; ``pairs`` is read lazily."""
        stream = iter(pairs)
        while batch := list(islice(stream, size)):
            images, truths = zip(*batch)
            yield from map(float, self.distances(np.stack(images), np.stack(truths)))

    def _true_features(self, truths: ByteArray) -> list[Tensor]:
        """The same as `_features`, from the cache where a frame was seen before: every method has the same truths."""
        keys = [hashlib.blake2b(np.ascontiguousarray(truth), digest_size=16).digest() for truth in truths]
        places = [(key, truth.shape) for key, truth in zip(keys, truths)]
        if all(place in self._cache for place in places):
            return [torch.cat(layer) for layer in zip(*(self._cache[place] for place in places))]
        features = self._features(truths)
        for index, place in enumerate(places):
            own = [layer[index : index + 1] for layer in features]
            size = sum(layer.numel() * layer.element_size() for layer in own)
            # What is full stays: frames come in the same order for every method, so that any frame put in the place
            # of another would have gone before its next turn.
            if place not in self._cache and self._held + size <= self._cache_bytes:
                self._cache[place] = [layer.clone() for layer in own]
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


@dataclass(frozen=True)
class SharedLpips:
    """LPIPS on the CPU whose weights are loaded when first used, once in a process.

    Every use raises `UnavailableError` where the weights cannot be had. Attributes: see `Lpips`.
    """

    net: str = "alex"
    scaled: bool = True

    def __call__(self, image: ByteArray, truth: ByteArray) -> float:
        """LPIPS of two (H, W, 3) 8-bit images."""
        return self._loaded()(image, truth)

    def batched(self, pairs: Iterable[tuple[ByteArray, ByteArray]]) -> Iterator[float]:
        """Distances of many pairs of one size, in order; ``pairs`` is read lazily."""
        return self._loaded().batched(pairs)

    def _loaded(self) -> Lpips:
        loaded = _load(self.net, self.scaled)
        if isinstance(loaded, UnavailableError):
            raise UnavailableError(loaded.what, loaded.remedy)
        return loaded


@functools.cache
def _load(net: str, scaled: bool) -> Lpips | UnavailableError:
    """The network, or why there is none: remembered either way."""
    try:
        return Lpips(net, scaled=scaled)
    except UnavailableError as error:
        return error


lpips = SharedLpips()
lpips_vgg = SharedLpips("vgg")
lpips_unscaled = SharedLpips(scaled=False)
lpips_vgg_unscaled = SharedLpips("vgg", scaled=False)
