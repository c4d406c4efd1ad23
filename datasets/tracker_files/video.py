"""A tracked video of a tracker's frames, their images and a head model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...bench.contracts import Camera, HeadPose
from ...bench.errors import InputError
from ..head.arrays import HeadArrays
from ..head.loaders import EYELIDS_REMEDY
from ..monocular.track import VIDEO, Track, VideoFrame, coefficients, ordered
from .frames import TrackedFrame
from .pictures import Picture, VideoPictures

CLOSED = 0.05
"""Eyelid coefficient above which an eye counts as partly closed; 1 closes it."""


def video_track(
    root: Path,
    frames: Sequence[TrackedFrame],
    pictures: VideoPictures,
    head: HeadArrays,
    *,
    resized: bool = False,
) -> Track:
    """Join frames, images and head model.

    Parameters
    ----------
    frames : Sequence[TrackedFrame]
        Of one video, at least one.
    head : HeadArrays
        Coefficients beyond its bases must be zero; missing ones are zero.
    resized : bool
        Whether images may have another size than the ones tracked, with the same ratio of width to height.
    """
    identities, expressions = head.shape_basis.shape[2], head.expression_basis.shape[2]
    found = []
    for frame in frames:
        picture = pictures.frames[frame.number]
        pose = HeadPose(
            head_model=head.version,
            expression=coefficients(frame.file, "flame.exp", frame.expression, expressions),
            rotation=np.zeros(3),
            neck=frame.neck,
            jaw=frame.jaw,
            eyes=frame.eyes,
            translation=np.zeros(3),
            eyelids=None if head.eyelid_basis is None else frame.eyelids,
        )
        camera = _camera(frame, picture, resized=resized)
        found.append(
            VideoFrame(
                where=(frame.file, ""),
                sequence=VIDEO,
                number=frame.number,
                image=picture.image,
                mask=picture.mask,
                camera=camera,
                pose=pose,
                inside=picture.inside,
            )
        )
    first = frames[0]
    return Track(
        frames=ordered(root, found),
        shape=coefficients(first.file, "flame.shape", first.shape, identities),
        held_out=None,
        files=frozenset(frame.file for frame in frames),
        solid=pictures.solid,
    )


def _camera(frame: TrackedFrame, picture: Picture, *, resized: bool) -> Camera:
    camera = Camera("0", frame.width, frame.height, frame.K, frame.world_to_camera)
    width, height = picture.info.width, picture.info.height
    same = (width, height) == (frame.width, frame.height)
    if not same and not (resized and width * frame.height == height * frame.width):
        expected = f"{frame.width}x{frame.height} pixels, the size that {frame.file.name} was tracked at"
        remedy = "Give the images that the tracker read, cropped and resized, with --images."
        raise InputError(picture.image, "", expected, f"{width}x{height}", remedy)
    return camera.resized(width, height)


def left_out(frames: Sequence[TrackedFrame], head: HeadArrays) -> Mapping[str, Any]:
    """What the head model cannot represent, with its size, by name; {} for nothing."""
    lids = np.array([frame.eyelids for frame in frames])
    largest = float(np.abs(lids).max())
    if not largest:
        return {}
    if head.eyelid_basis is None:
        used = int((np.abs(lids).max(axis=1) > CLOSED).sum())
        return {
            "eyelids": f"up to {largest:.2f} (1 closes an eye), above {CLOSED} in {used} of {len(frames)} frames. "
            f"The head model has no eyelid basis. {EYELIDS_REMEDY}"
        }
    moved = np.abs(lids) @ np.linalg.norm(head.eyelid_basis, axis=1).max(axis=0)
    neck = 2 * np.sin(np.linalg.norm([frame.neck for frame in frames], axis=1) / 2)
    error = 1e3 * float((moved * neck).max())
    # Trackers turn lids with the root alone, this project with root and neck.
    return (
        {"eyelids_with_neck": f"lids turn with the neck here: up to {error:.2f} mm"} if error >= 0.005 else {}
    )
