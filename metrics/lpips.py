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

import numpy as np

from ..bench.contracts import ByteArray
from ..bench.errors import HeadbenchError, LeftOutError, UnavailableError
from ..bench.machine import use_device
from ..bench.specs import MetricSpec, Need
from .psnr import Mask, check_masks, check_pair

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

LPIPS_SQUEEZE = replace(
    LPIPS,
    name="lpips-squeeze",
    default=False,
    label="LPIPS SqueezeNet",
    implementation="headbench.metrics.lpips:lpips_squeeze",
    needs="headbench.metrics.lpips:needs_squeeze",
    summary="Learned perceptual distance v0.1, SqueezeNet, inputs scaled to [-1, 1].",
)


LPIPS_FACE = replace(
    LPIPS,
    name="lpips-face",
    default=False,
    label="LPIPS face",
    kind="face",
    implementation="headbench.metrics.lpips:lpips_face",
    summary="LPIPS with AlexNet of the square around the visible face, resized to 256 x 256.",
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


SIDE = 256
"""Side of the resized face crop, pixels."""
LEAST_SIDE = 16
"""Side of the face crop before it is resized, pixels; a smaller one is not scored."""
LEAST_SHARE = 0.25
"""Share of the face crop that shows the face, below which it is not scored. On the procedural head it is 0.60 from the front, 0.37
in profile, and 0.25 where the head is turned by 110 degrees."""


@dataclass(frozen=True)
class FaceLpips:
    """LPIPS of the face crop.

    The crop is the smallest square around the visible pixels of the region "face" of the tracked mesh, about the centre of their
    bounding box, without a margin; beyond the frame the frame's outermost pixels are repeated. Both images are cropped to it and
    resized to 256 x 256 pixels (area means if that reduces them, else bilinear), because LPIPS depends on the size of the face
    in pixels. The definition is headbench's own: papers crop by the boxes of different landmark detectors.

    A frame is left out, for every method alike, if the face is off screen or turned away: less than a quarter of the crop shows
    it, or the crop has less than 16 pixels a side before it is resized.
    """

    whole: SharedLpips = SharedLpips()

    def on(self, device: str) -> FaceLpips:
        """This metric on another device."""
        return replace(self, whole=self.whole.on(device))

    def __call__(self, image: ByteArray, target: ByteArray, face: Mask) -> float:
        """LPIPS of the crops of two (H, W, 3) 8-bit images; ``face`` is the (H, W) mask of the face's visible pixels."""
        check_pair(image, target)
        check_masks({"face": face}, target)
        top, left, side = face_square(face)
        if side < LEAST_SIDE or face.sum() < LEAST_SHARE * side**2:
            raise LeftOutError("the face is off screen or turned away")
        return self.whole(*(_crop(each, top, left, side) for each in (image, target)))


def face_square(face: Mask) -> tuple[int, int, int]:
    """Top, left and side, in pixels, of the square around a mask; it may extend beyond the frame. The side is 0 for no pixels."""
    rows, columns = (np.flatnonzero(face.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return 0, 0, 0
    side = 1 + max(int(np.ptp(rows)), int(np.ptp(columns)))
    top, left = ((int(at[0] + at[-1]) + 1 - side) // 2 for at in (rows, columns))
    return top, left, side


def _crop(image: ByteArray, top: int, left: int, side: int) -> ByteArray:
    import cv2

    height, width = image.shape[:2]
    rows = np.clip(np.arange(top, top + side), 0, height - 1)
    columns = np.clip(np.arange(left, left + side), 0, width - 1)
    how = cv2.INTER_AREA if side > SIDE else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image[np.ix_(rows, columns)], (SIDE, SIDE), interpolation=how), np.uint8)


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
lpips_squeeze = SharedLpips("squeeze")
lpips_face = FaceLpips()
lpips_unscaled = SharedLpips(scaled=False)
lpips_vgg_unscaled = SharedLpips("vgg", scaled=False)


def needs_alex(config: Any, device: str) -> Iterator[Need]:
    """Weights of AlexNet on this machine, without a download."""
    yield _weights("alex")


def needs_vgg(config: Any, device: str) -> Iterator[Need]:
    """Weights of VGG-16 on this machine, without a download."""
    yield _weights("vgg")


def needs_squeeze(config: Any, device: str) -> Iterator[Need]:
    """Weights of SqueezeNet on this machine, without a download."""
    yield _weights("squeeze")


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
