"""Learned perceptual image patch similarity of one frame.

Zhang, Isola, Efros, Shechtman, Wang, "The unreasonable effectiveness of deep features as a perceptual metric",
CVPR 2018, equation 1, version 0.1 (with the scaling layer). Inputs are scaled to [-1, 1], as the scaling
layer's constants expect. Feeding [0, 1] instead, as some published avatar code does, gives lower numbers that
are not comparable. `Lpips` supports both, under different names.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from ..bench.contracts import ByteArray
from ..bench.errors import HeadbenchError, UnavailableError
from ..bench.machine import use_device
from ..bench.specs import MetricSpec, Need

if TYPE_CHECKING:
    from .lpips_network import Lpips

LPIPS = MetricSpec(
    name="lpips",
    label="LPIPS",
    unit="",
    higher_is_better=False,
    digits=4,
    implementation="headbench.metrics.lpips:lpips",
    summary="Learned perceptual distance v0.1, AlexNet, inputs scaled to [-1, 1].",
    default=True,
    needs="headbench.metrics.lpips:needs_alex",
)

LPIPS_VGG = replace(
    LPIPS,
    name="lpips-vgg",
    default=False,
    label="LPIPS VGG",
    implementation="headbench.metrics.lpips:lpips_vgg",
    needs="headbench.metrics.lpips:needs_vgg",
    summary="Learned perceptual distance v0.1, VGG-16, inputs scaled to [-1, 1].",
)


@dataclass(frozen=True)
class SharedLpips:
    """LPIPS that loads its weights on first use, once per process and device.

    Every use raises `UnavailableError` if the weights are not available. Attributes: see `Lpips`.
    """

    net: str = "alex"
    scaled: bool = True
    device: str = "cpu"

    def on(self, device: str) -> SharedLpips:
        """This metric on another device; on a GPU in float32 without TF32."""
        return replace(self, device=device)

    def __call__(self, image: ByteArray, target: ByteArray) -> float:
        """LPIPS of two (H, W, 3) 8-bit images."""
        return self._loaded()(image, target)

    def batched(self, pairs: Iterable[tuple[ByteArray, ByteArray]]) -> Iterator[float]:
        """Distances of many pairs, in order; ``pairs`` is read lazily."""
        return self._loaded().batched(pairs)

    def _loaded(self) -> Lpips:
        loaded = _load(self.net, self.scaled, self.device)
        if isinstance(loaded, UnavailableError):
            raise UnavailableError(loaded.what, loaded.remedy, loaded.note)
        return loaded


@functools.cache
def _load(net: str, scaled: bool, device: str) -> Lpips | UnavailableError:
    """The network, or the reason why it is unavailable; both are cached."""
    from .lpips_network import Lpips

    use_device(device)
    try:
        return Lpips(net, scaled=scaled, device=device)
    except UnavailableError as error:
        return error


lpips = SharedLpips()
lpips_vgg = SharedLpips("vgg")
lpips_unscaled = SharedLpips(scaled=False)
lpips_vgg_unscaled = SharedLpips("vgg", scaled=False)


def needs_alex(config: Any, device: str) -> Iterator[Need]:
    """Weights of AlexNet on this machine, without a download."""
    yield _weights("alex")


def needs_vgg(config: Any, device: str) -> Iterator[Need]:
    """Weights of VGG-16 on this machine, without a download."""
    yield _weights("vgg")


def _weights(net: str) -> Need:
    from .lpips_network import NETWORKS, VARIABLE, cache_folder, present_backbone

    spec = NETWORKS[net]
    remedy = (
        f"They are fetched from {spec.url} when first used; without a network, put that file into {cache_folder()} or set "
        f"{VARIABLE} to it. Cells of {net} LPIPS stay empty meanwhile."
    )
    try:
        path = present_backbone(spec)
    except HeadbenchError as error:
        return Need(f"weights of {net}", "", str(error), required=False)
    return Need(f"weights of {net}", "" if path is None else str(path), remedy, required=False)
