"""Measures of driven poses: jitter, identity spill, lip closure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ...bench.contracts import FloatArray, HeadPose, IntArray
from ..head.arrays import JOINT_NAMES, HeadArrays
from ..head.refit.identity import FACE
from ..head.subject import PosedSubject, pose_in_head_frame

_MILLIMETRES = 1e3
_MIDDLE = 0.25
"""Share of the lips' width, on either side of their middle, in which the distance of the lips is measured; corners touch."""
_JAW = JOINT_NAMES.index("jaw")


class DrivenMeasures:
    """Measures on the vertices of one subject.

    Parameters
    ----------
    shape : FloatArray
        (S,) identity of the avatar.
    static_offset : FloatArray
        (V, 3) metres.
    """

    def __init__(self, head: HeadArrays, shape: FloatArray, static_offset: FloatArray):
        self._subject = PosedSubject(head, shape, static_offset)
        everything = np.arange(len(head.template))
        face = np.asarray(head.regions.get(FACE, everything))
        self._face = face if len(face) else everything
        self._lips = _lips(head, self._subject.neutral)

    def jitter_mm(self, poses: Sequence[HeadPose]) -> float | None:
        """Mean length of the second difference over time of the vertices of the face, millimetres; None for fewer than 3 frames."""
        if len(poses) < 3:
            return None
        total, before = 0.0, []
        for mesh in self._meshes(poses, self._face):
            before.append(mesh)
            if len(before) == 3:
                total += float(np.linalg.norm(before[2] - 2 * before[1] + before[0], axis=1).mean())
                before.pop(0)
        return _MILLIMETRES * total / (len(poses) - 2)

    def spill_mm(self, pose: HeadPose) -> float:
        """Root mean square distance of the vertices of the face between the neutral head and a pose, head motion apart; millimetres."""
        (mesh,) = self._meshes([pose_in_head_frame(pose)], self._face)
        squares = np.square(mesh - self._subject.neutral[self._face]).sum(axis=1)
        return _MILLIMETRES * float(np.sqrt(squares.mean()))

    def lip_distances_mm(self, poses: Sequence[HeadPose]) -> FloatArray | None:
        """(T,) smallest distances between the middle of the upper and the lower lip, millimetres; None for heads without lips."""
        if self._lips is None:
            return None
        both, count, found = np.concatenate(self._lips), len(self._lips[0]), []
        for mesh in self._meshes(poses, both):
            gaps = mesh[:count, None] - mesh[None, count:]
            found.append(np.linalg.norm(gaps, axis=2).min())
        return _MILLIMETRES * np.array(found)

    def _meshes(self, poses: Sequence[HeadPose], vertices: IntArray) -> Iterator[FloatArray]:
        """(n, 3) vertices of each pose."""
        for batch in self._subject.batches(poses):
            yield from batch[:, vertices]


def _lips(head: HeadArrays, neutral: FloatArray) -> tuple[IntArray, IntArray] | None:
    """Vertices of the middle of the upper and of the lower lip, which are those that the jaw moves less or more than half way."""
    lips = np.asarray(head.regions.get("lips", ()), np.int64)
    if not len(lips):
        return None
    across = neutral[lips, 0]
    middle, width = (across.min() + across.max()) / 2, np.ptp(across)
    lips = lips[np.abs(across - middle) < _MIDDLE * width]
    share = head.skinning_weights[lips, _JAW]
    share = share / max(float(share.max(initial=0.0)), np.finfo(np.float64).tiny)
    upper, lower = lips[share < 0.5], lips[share >= 0.5]
    return (upper, lower) if len(upper) and len(lower) else None
