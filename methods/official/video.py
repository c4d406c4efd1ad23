"""Common code for repositories that train on a tracked video: straight alpha, 6D rotations, the head's frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from ...bench.contracts import ByteArray, Camera, Clip, FloatArray, FrameKey, HeadPose
from ...bench.errors import InputError
from ...datasets.head.subject import PosedSubject, camera_in_head_frame
from ...datasets.steps.masks import recomposite


def check_masks(clip: Clip) -> None:
    """Raise `InputError` for a clip without masks, judged by its first training frame; `straight_rgba` checks the others."""
    coverage_of(clip, clip.splits["train"][0])


def coverage_of(clip: Clip, key: FrameKey) -> ByteArray:
    """(H, W) mask of a frame. Raises `InputError` if it is missing."""
    mask = clip.mask(key)
    if mask is None:
        expected = "a mask; the code trains only on the head, selected by the fourth channel of its images"
        remedy = "Matte the capture (INSTA's generate.sh does), or use the native method, which needs none."
        raise InputError(f"clip {clip.subject}", str(key), expected, "none", remedy)
    return mask


def straight_rgba(clip: Clip, key: FrameKey) -> ByteArray:
    """(H, W, 4) straight alpha: contribution of the head to a pixel divided by its coverage, without the background.

    Colours times coverage equal the frame on black within half a level. Raises `InputError` for a frame without a mask.
    """
    mask = coverage_of(clip, key)
    coverage = mask.astype(np.float32) / 255
    image = clip.image(key).astype(np.float32) / 255
    black = np.zeros(3, np.float32)
    colours = recomposite(image, coverage, np.asarray(clip.background, np.float32), black)
    colours /= np.maximum(coverage, 1 / 255)[..., None]
    return np.dstack([np.round(255 * colours).astype(np.uint8), mask])


def six_numbers(turns: FloatArray) -> FloatArray:
    """(6 n,) the first two rows of each rotation's matrix, of (3 n,) axis-angle vectors."""
    matrices = Rotation.from_rotvec(np.reshape(turns, (-1, 3))).as_matrix()
    return np.asarray(matrices[:, :2].ravel(), np.float64)


def cameras_at_rest(
    subject: PosedSubject, views: Sequence[tuple[Camera, HeadPose]], size: int = 64
) -> list[Camera]:
    """The camera of each view relative to a head that does not move, and poses without rigid motion."""
    cameras = []
    for start in range(0, len(views), size):
        part = views[start : start + size]
        motions = subject.motions([pose for _, pose in part])
        cameras += [camera_in_head_frame(camera, motion) for (camera, _), motion in zip(part, motions)]
    return cameras
