"""Whether renders were made on the background that the protocol declares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..contracts import BoolArray, ByteArray, Clip, FloatArray, FrameKey
from ..errors import InputError
from ..io.images import read_png
from .naming import Render, composited

SAMPLE = 8
"""Number of frames checked per subject and task, evenly spaced."""
TOLERANCE = 24.0
"""Maximum difference of the background's colour, in 8-bit levels of a channel.

In the demo it is 0 in each frame of the five methods and two trivial baselines, since less than half of the pixels differ
(at most 18 %, for `mean-image`); black instead of white differs by 255.
"""
EXACT = 2
"""Maximum difference, in 8-bit levels, of ground-truth pixels that count as background."""
CORNER = 8
"""A corner is a square of the image's shorter side divided by this."""
LEAST = 0.005
"""Minimum share of background pixels; frames with fewer are not checked."""


def check_background(clip: Clip, renders: Mapping[FrameKey, Render]) -> None:
    """Compare the background of renders of one task with the clip's, on a sample of frames.

    The background colour of a frame is the median over the pixels of `certain_background`. Since a poor method may
    fail in some frames, `InputError` is raised only if more than half of the sample differs by more than
    `TOLERANCE`.
    """
    declared = 255 * np.asarray(clip.background, dtype=np.float64)
    keys = sorted(renders)
    judged: list[tuple[FrameKey, FloatArray]] = []
    for key in keys[:: max(1, len(keys) // SAMPLE)]:
        colour = background_colour(clip, key, _pixels(renders[key], clip))
        if colour is not None:
            judged.append((key, colour))
    wrong = [(key, colour) for key, colour in judged if np.abs(colour - declared).max() > TOLERANCE]
    if 2 * len(wrong) <= len(judged):
        return
    found = np.median([colour for _, colour in wrong], axis=0)
    expected = f"the background of the capture, {_rgb(declared)}, where the ground truth shows it"
    raise InputError(
        renders[wrong[0][0]].image,
        "background",
        expected,
        f"{_rgb(found)} (in {len(wrong)} of {len(judged)} frames checked)",
        f"Composite the renders on {_rgb(declared)}, or score them as they are with --any-background.",
    )


def background_colour(clip: Clip, key: FrameKey, image: ByteArray) -> FloatArray | None:
    """(3,) median background colour of an image, 0 to 255; None with too few pixels that are certainly background."""
    ground = certain_background(clip, key)
    return np.median(image[ground], axis=0) if ground.mean() >= LEAST else None


def certain_background(clip: Clip, key: FrameKey) -> BoolArray:
    """(H, W) mask of the pixels in which the ground truth shows only the clip's background.

    These pixels have its colour and are outside of the mask or, without a mask, in a corner of the image.
    """
    truth, mask = clip.image(key), clip.mask(key)
    plain = np.asarray((np.abs(truth - 255 * np.asarray(clip.background)) <= EXACT).all(axis=-1))
    if mask is not None:
        return np.asarray(plain & (mask == 0))
    height, width = plain.shape
    side = max(1, min(height, width) // CORNER)
    rows, columns = (np.minimum(np.arange(n), np.arange(n)[::-1]) < side for n in (height, width))
    return plain & rows[:, None] & columns


def _pixels(render: Render, clip: Clip) -> ByteArray:
    if render.alpha is not None:
        return composited(render, clip.background.tolist())
    return read_png(render.image)


def _rgb(colour: FloatArray | Sequence[float]) -> str:
    return "RGB {:.0f}, {:.0f}, {:.0f}".format(*colour)
