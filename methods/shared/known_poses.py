"""What poses decide, computed beforehand for those that are known, within a bound of memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Generic, Protocol, TypeVar

import numpy as np
import torch

from ...bench.contracts import HeadPose

DRIVING = ("expression", "rotation", "neck", "jaw", "eyes", "translation", "eyelids")


class Sized(Protocol):
    """A value that knows its memory."""

    @property
    def bytes(self) -> int: ...


Value = TypeVar("Value", bound=Sized)


class KnownPoses(Generic[Value]):
    """Values by pose. A pose is known by all its numbers, so that it never answers to another one's timestep."""

    def __init__(self, compute: Callable[[HeadPose], Value], limit: int):
        self._compute, self._limit = compute, limit
        self._values: dict[bytes, Value] = {}

    @torch.no_grad()
    def prepare(self, poses: Iterable[HeadPose]) -> int:
        """Compute the values of poses in order for as long as they fit into ``limit`` bytes; returns how many do."""
        taken, count = 0, 0
        for pose in poses:
            key = pose_key(pose)
            if key not in self._values:
                value = self._compute(pose)
                taken += value.bytes
                if taken > self._limit:
                    break
                self._values[key] = value
            count += 1
        return count

    def __call__(self, pose: HeadPose) -> Value:
        """The value of a pose, computed if it is not known; then it is not kept."""
        value = self._values.get(pose_key(pose)) if self._values else None
        return self._compute(pose) if value is None else value


def pose_key(pose: HeadPose) -> bytes:
    """All the numbers of a pose; equal keys pose alike."""
    parts = [pose.head_model.encode()]
    for name in DRIVING:
        values = getattr(pose, name)
        parts.append(b"-" if values is None else np.asarray(values, np.float64).tobytes())
    return b"|".join(parts)
