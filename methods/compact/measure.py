"""What storing an avatar compactly costs in quality, part by part."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ...bench.contracts import ByteArray, Camera, Clip, FrameKey, HeadAsset, HeadPose
from ...bench.io.images import quantise
from ..ours.avatar import OursAvatar
from ..shared.losses import mean_ssim
from ..shared.subject_mesh import SubjectMesh
from .container import Content
from .file import COMPACT_FILE, decode


class Quality(NamedTuple):
    """Of an avatar's pictures."""

    psnr: float
    """dB against the truth, mean over frames; NaN where there is none."""
    ssim: float
    """Against the truth, likewise; by the training's own window."""
    psnr_exact: float
    """dB against the exact avatar's pictures, of the mean squared error over all frames; infinite where equal."""


class Comparison:
    """Held-out frames of a clip as the exact avatar draws them, and as they are.

    Parameters
    ----------
    frames : how many, spread evenly over both held-out splits.
    scale : enlargement of the pictures; above 1 there is no truth.
    """

    def __init__(self, clip: Clip, exact: OursAvatar, frames: int, scale: int = 1):
        self._clip, self._scale = clip, scale
        self.keys = _spread(
            [key for split in ("novel_view", "self_reenactment") for key in clip.splits[split]], frames
        )
        self._truth = [clip.image(key) for key in self.keys] if scale == 1 else None
        self._exact = self._pictures(exact)
        self.exact = self._quality(self._exact)

    def __call__(self, avatar: OursAvatar) -> Quality:
        """Quality of another avatar's pictures of the same frames."""
        return self._quality(self._pictures(avatar))

    def _pictures(self, avatar: OursAvatar) -> list[ByteArray]:
        background = tuple(float(channel) for channel in self._clip.background)
        return [quantise(avatar.render(*self._workload(key), background).rgb) for key in self.keys]

    def _workload(self, key: FrameKey) -> tuple[Camera, HeadPose]:
        camera = self._clip.cameras[key.camera]
        camera = camera.resized(self._scale * camera.width, self._scale * camera.height)
        return camera, self._clip.poses[key.timestep]

    def _quality(self, pictures: Sequence[ByteArray]) -> Quality:
        against_exact = _psnr(float(np.mean([_error(a, b) for a, b in zip(pictures, self._exact)])))
        if self._truth is None:
            return Quality(math.nan, math.nan, against_exact)
        psnr = [_psnr(_error(picture, truth)) for picture, truth in zip(pictures, self._truth)]
        similarity = [_ssim(picture, truth) for picture, truth in zip(pictures, self._truth)]
        return Quality(float(np.mean(psnr)), float(np.mean(similarity)), against_exact)


def avatar_of(content: Content, head: HeadAsset) -> OursAvatar:
    """The avatar that a compact file of such a content would give."""
    faces, expressions = len(head.faces), head.expression_basis.shape[2]
    subject, field = decode(Path(COMPACT_FILE), content, head, faces, expressions, "cpu")
    mesh = SubjectMesh(head, subject.shape, subject.static_offset, "cpu")
    return OursAvatar([], mesh, subject, field, "cpu")


def _spread(keys: Sequence[FrameKey], count: int) -> list[FrameKey]:
    chosen = np.unique(np.linspace(0, len(keys) - 1, min(count, len(keys))).round().astype(int))
    return [keys[index] for index in chosen]


def _error(picture: ByteArray, truth: ByteArray) -> float:
    return float(np.mean((picture.astype(np.float64) - truth) ** 2))


def _psnr(error: float) -> float:
    return math.inf if error == 0 else 10 * math.log10(255**2 / error)


def _ssim(picture: ByteArray, truth: ByteArray) -> float:
    planes = [torch.from_numpy(image.astype(np.float32) / 255).permute(2, 0, 1) for image in (picture, truth)]
    return float(mean_ssim(*(image.contiguous() for image in planes)))
