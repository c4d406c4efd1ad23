"""Training images as tensors, decoded one iteration ahead of need."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import torch
from torch import Tensor

from ....bench.contracts import ByteArray, Clip, FrameKey
from ....bench.errors import InputError
from .sampling import Sampler


class TrainingImages:
    """Images of a clip by index. What they cost in memory is the clip's affair; this holds two at most.

    ``clip.image`` and ``clip.mask`` are called from a thread, one call at a time.

    Parameters
    ----------
    mattes : whether images come with a fourth channel, the foreground's coverage.
    """

    def __init__(
        self, clip: Clip, keys: Sequence[FrameKey], sampler: Sampler, device: str, *, mattes: bool = False
    ):
        self._clip, self._keys, self._sampler, self._device = clip, keys, sampler, device
        self._mattes = mattes
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="decode")
        self._ahead: tuple[int, Future[Tensor]] | None = None

    def get(self, iteration: int, index: int) -> Tensor:
        """(H, W, 3 or 4) float32 in [0, 1]; starts decoding the image of the next iteration."""
        if self._ahead is None or self._ahead[0] != index:
            self._ahead = (index, self._pool.submit(self._load, index))
        image = self._ahead[1].result()
        following = self._sampler(iteration + 1)
        self._ahead = (following, self._pool.submit(self._load, following))
        return image.to(self._device).to(torch.float32).div_(255)

    def close(self) -> None:
        """Stop the decoding thread."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _load(self, index: int) -> Tensor:
        key = self._keys[index]
        image = self._clip.image(key)
        camera = self._clip.cameras[key.camera]
        expected = (camera.height, camera.width, 3)
        if image.shape != expected or image.dtype != np.uint8:
            raise InputError(
                str(key), "image", f"uint8 of shape {expected}", f"{image.dtype} of shape {image.shape}"
            )
        if self._mattes:
            image = np.dstack([image, self._matte(key, expected[:2])])
        # A clip's images may be read-only and shared; torch wants an array it may write to.
        return torch.from_numpy(np.array(image, copy=True))

    def _matte(self, key: FrameKey, expected: tuple[int, int]) -> ByteArray:
        matte = self._clip.mask(key)
        if matte is None or matte.shape != expected or matte.dtype != np.uint8:
            found = "none" if matte is None else f"{matte.dtype} of shape {matte.shape}"
            raise InputError(str(key), "mask", f"uint8 of shape {expected}", found)
        return matte


def recomposited(image: Tensor, coverage: Tensor, recorded_on: Tensor, background: Tensor) -> Tensor:
    """Colours (..., 3) on another background than the one they were recorded on; ``coverage`` is (..., 1) in [0, 1]."""
    return image + (1 - coverage) * (background - recorded_on)
