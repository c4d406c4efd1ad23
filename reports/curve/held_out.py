"""A clip with some of its training frames held out, to choose settings without looking at test frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import Any, Literal

import numpy as np

from ...bench.contracts import (
    ByteArray,
    Camera,
    Clip,
    FloatArray,
    FrameKey,
    HeadAsset,
    HeadPose,
    StepRecord,
    TaskName,
)
from ...bench.errors import HeadbenchError, InputError
from ...bench.io.files import digest

CAMERA: TaskName = "novel_view"
TIMESTEPS: TaskName = "self_reenactment"


@dataclass(frozen=True, eq=False)
class HeldOutClip:
    """A `Clip` whose splits are parts of another's training split; no other frame of that can be read.

    "novel_view" has the frames of the held-out camera, "self_reenactment" those of the held-out timesteps, in all
    training cameras.
    """

    source: Clip
    subject: str
    head: HeadAsset
    shape: FloatArray
    static_offset: FloatArray
    cameras: Mapping[str, Camera]
    poses: Mapping[int, HeadPose]
    splits: Mapping[str, tuple[FrameKey, ...]]
    excluded: Mapping[FrameKey, str]
    background: FloatArray
    steps: Sequence[StepRecord]
    fingerprint: str

    def image(self, key: FrameKey) -> ByteArray:
        """(H, W, 3) 8-bit sRGB. Raises `HeadbenchError` for a frame that is in none of the splits."""
        return self.source.image(self._checked(key))

    def mask(self, key: FrameKey) -> ByteArray | None:
        """(H, W) 8-bit coverage or None. Raises `HeadbenchError` for a frame that is in none of the splits."""
        return self.source.mask(self._checked(key))

    @cached_property
    def _readable(self) -> frozenset[FrameKey]:
        return frozenset(key for keys in self.splits.values() for key in keys)

    def _checked(self, key: FrameKey) -> FrameKey:
        if key not in self._readable:
            raise HeadbenchError(f"{key} was to be read, which is no training frame of the capture")
        return key


def hold_out(clip: Clip, camera: str, every: int) -> HeldOutClip:
    """Hold out a camera and every n-th timestep of a clip's training split.

    Parameters
    ----------
    camera : its name; "": the training camera nearest to the mean position of all, none where there is only one.
    every : the middle one of every so many training timesteps, counted in their order, is held out.

    Raises
    ------
    InputError
        For a camera that is not one of training, and where no frame is left to train with or to measure on.
    """
    train = clip.splits["train"]
    where = f"clip {clip.subject}"
    cameras = sorted({key.camera for key in train})
    if camera and camera not in cameras:
        raise InputError(where, "camera", f"a training camera: {', '.join(cameras)}", repr(camera))
    if not camera and len(cameras) > 1:
        centers = np.array([clip.cameras[name].center for name in cameras])
        camera = cameras[int(np.linalg.norm(centers - centers.mean(0), axis=1).argmin())]
    timesteps = sorted({key.timestep for key in train})
    held = timesteps[min(every, len(timesteps)) // 2 :: every] if len(timesteps) > 1 else []
    splits: dict[str, list[FrameKey]] = {"train": [], CAMERA: [], TIMESTEPS: []}
    for key in train:
        name = TIMESTEPS if key.timestep in held else CAMERA if key.camera == camera else "train"
        splits[name].append(key)
    if not splits["train"] or not splits[CAMERA] + splits[TIMESTEPS]:
        found = f"{len(cameras)} cameras and {len(timesteps)} timesteps"
        expected = "frames to train with and others to hold out"
        raise InputError(where, "splits.train", expected, found)
    step = StepRecord("hold_out", {"camera": camera, "timesteps": held}, clip.fingerprint)
    return HeldOutClip(
        source=clip,
        subject=clip.subject,
        head=clip.head,
        shape=clip.shape,
        static_offset=clip.static_offset,
        cameras=clip.cameras,
        poses=clip.poses,
        splits={name: tuple(keys) for name, keys in splits.items() if keys},
        excluded=clip.excluded,
        background=clip.background,
        steps=(*clip.steps, step),
        fingerprint=digest(clip.fingerprint, "hold_out", camera, held),
    )


Part = Literal["cameras", "timesteps"]
"""Of what a training may see a part only."""


def reduced(clip: HeldOutClip, what: Part, part: Fraction) -> HeldOutClip:
    """A clip with a part of its training cameras or timesteps, one at least, spread evenly; held-out frames stay.

    Of cameras the first is the one nearest to the mean position of all, each further one that farthest from those taken
    (Gonzalez, "Clustering to minimize the maximum intercluster distance", 1985), so that fewer are among more.
    """
    train = clip.splits["train"]
    chosen: list[Any]
    if what == "cameras":
        names = _spread(clip.cameras, sorted({key.camera for key in train}))
        chosen = names[: max(1, round(len(names) * part))]
        keys = tuple(key for key in train if key.camera in chosen)
    else:
        timesteps = sorted({key.timestep for key in train})
        count = max(1, round(len(timesteps) * part))
        chosen = [timesteps[(2 * i + 1) * len(timesteps) // (2 * count)] for i in range(count)]
        keys = tuple(key for key in train if key.timestep in chosen)
    if len(keys) == len(train):
        return clip
    step = StepRecord("reduce_training", {what: chosen}, clip.fingerprint)
    return replace(
        clip,
        splits={**clip.splits, "train": keys},
        steps=(*clip.steps, step),
        fingerprint=digest(clip.fingerprint, what, chosen),
    )


def _spread(cameras: Mapping[str, Camera], names: Sequence[str]) -> list[str]:
    """Names of cameras, each as far as possible from those before it."""
    centers = np.array([cameras[name].center for name in names])
    order = [int(np.linalg.norm(centers - centers.mean(0), axis=1).argmin())]
    distances = np.full(len(names), np.inf)
    while len(order) < len(names):
        distances = np.minimum(distances, np.linalg.norm(centers - centers[order[-1]], axis=1))
        distances[order] = -1.0
        order.append(int(distances.argmax()))
    return [names[index] for index in order]
