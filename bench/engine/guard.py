"""Prevents a method from reading test images and from changing the inputs of other methods.

This prevents mistakes, not malicious code: a method runs in the same process.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from ..contracts import ByteArray, Clip, Frame, FrameKey, HeadAsset
from ..errors import HeadbenchError, InputError

HEAD = tuple(name for name in vars(HeadAsset) if not name.startswith("_"))
SHARED = ("shape", "static_offset", "background", "cameras", "poses")
"""Attributes of a clip that all methods share."""
SLACK = 1e-3
"""How far colours and coverage may exceed [0, 1]: rounding in float32, below a quarter of an 8-bit step."""


class TrainingView:
    """A read-only `Clip` with images and masks of training frames only.

    Cameras and driving signals of held-out frames stay visible: they do not reveal the ground truth images.
    """

    def __init__(self, clip: Clip):
        freeze(clip)
        allowed = frozenset(clip.splits["train"])
        self.subject, self.head, self.shape = clip.subject, clip.head, clip.shape
        self.static_offset, self.background = clip.static_offset, clip.background
        self.cameras, self.poses = MappingProxyType(clip.cameras), MappingProxyType(clip.poses)
        self.splits, self.excluded = MappingProxyType(clip.splits), MappingProxyType(clip.excluded)
        self.steps, self.fingerprint = tuple(clip.steps), clip.fingerprint

        def image(key: FrameKey) -> ByteArray:
            """(H, W, 3) 8-bit sRGB of a training frame. Raises `HeadbenchError` for any other."""
            return _copied(clip.image(_checked(key)))

        def mask(key: FrameKey) -> ByteArray | None:
            """(H, W) 8-bit coverage of a training frame. Raises `HeadbenchError` for any other."""
            found = clip.mask(_checked(key))
            return None if found is None else _copied(found)

        def _checked(key: FrameKey) -> FrameKey:
            if key not in allowed:
                raise HeadbenchError(f"the method read {key}, which is not a training frame")
            return key

        self.image, self.mask = image, mask


def _copied(image: ByteArray) -> ByteArray:
    """A copy that cannot be made writable; the reader may reuse the original array in the next call."""
    return np.frombuffer(image.tobytes(), image.dtype).reshape(image.shape)


def freeze(clip: Clip) -> None:
    """Make the arrays of a clip read-only, in place: those of its head model, cameras, poses, shape and background."""
    for array in _arrays(clip):
        array.flags.writeable = False


def check_frame(frame: Frame, size: tuple[int, int], name: str, key: FrameKey) -> None:
    """Raise `InputError` unless a frame has (height, width) ``size`` and finite values in [0, 1]."""
    for part, shape in (("rgb", (*size, 3)), ("alpha", size)):
        values = np.asarray(getattr(frame, part))
        if values.shape != shape:
            raise InputError(name, f"{part} of {key}", f"shape {shape}", f"{values.shape}")
        low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
        if not (low >= -SLACK and high <= 1 + SLACK):  # written so that NaN is refused, too
            raise InputError(
                name, f"{part} of {key}", "finite values from 0 to 1", f"values from {low:g} to {high:g}"
            )


def _arrays(clip: Clip) -> Iterator[np.ndarray[Any, Any]]:
    """The arrays that all methods share, in an order that depends on the clip alone."""
    for name in HEAD:
        yield from _within(getattr(clip.head, name, None))
    for name in SHARED:
        yield from _within(getattr(clip, name))


def _within(value: Any) -> Iterator[np.ndarray[Any, Any]]:
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, Mapping):
        for _, each in sorted(value.items()):
            yield from _within(each)
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from _within(getattr(value, field.name))
