"""Tracked parameters with the errors of a tracker."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...bench.contracts import HeadPose

_FIELDS = ("expression", "rotation", "neck", "jaw", "eyes", "translation", "eyelids")


def with_tracking_noise(poses: Sequence[HeadPose], amount: float, seed: int) -> list[HeadPose]:
    """Add Gaussian noise to every parameter, independent from timestep to timestep.

    Its standard deviation is ``amount`` times that parameter's own over ``poses``, so a parameter that never
    moves stays exact. ``amount`` 0 returns the poses as they are.
    """
    if amount == 0.0:
        return list(poses)
    rng = np.random.default_rng([seed, 5])
    changed: list[dict[str, Any]] = [{} for _ in poses]
    for name in _FIELDS:
        if getattr(poses[0], name) is None:
            continue
        values = np.stack([getattr(pose, name) for pose in poses])
        noisy = values + amount * values.std(axis=0) * rng.standard_normal(values.shape)
        for fields, row in zip(changed, noisy):
            fields[name] = row.astype(np.float32).astype(np.float64)
    return [replace(pose, **fields) for pose, fields in zip(poses, changed)]
