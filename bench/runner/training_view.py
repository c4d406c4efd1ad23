"""What training may see of a clip: the images of its training split and no other."""

from __future__ import annotations

from typing import Any

from ..contracts import ByteArray, Clip, FrameKey
from ..errors import HeadbenchError


class TrainingView:
    """A `Clip` that gives images and masks of training frames only; all else is the clip's own.

    Cameras and driving signals of held-out frames stay visible: they are no ground truth of how a frame looks.
    """

    def __init__(self, clip: Clip):
        self._clip = clip
        self._allowed = frozenset(clip.splits["train"])

    def __getattr__(self, name: str) -> Any:
        return getattr(self._clip, name)

    def image(self, key: FrameKey) -> ByteArray:
        """(H, W, 3) 8-bit sRGB of a training frame. Raises `HeadbenchError` for any other."""
        return self._clip.image(self._checked(key))

    def mask(self, key: FrameKey) -> ByteArray | None:
        """(H, W) 8-bit coverage of a training frame. Raises `HeadbenchError` for any other."""
        return self._clip.mask(self._checked(key))

    def _checked(self, key: FrameKey) -> FrameKey:
        if key not in self._allowed:
            raise HeadbenchError(f"the method read {key}, which is not a training frame")
        return key
