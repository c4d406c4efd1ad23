"""Jaw bases: a few jaw rotations that span those of a performance, and the weights of a pose on them.

"3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations"
(CVPR 2025, arXiv 2504.14967), section on feature lines. The paper's code selects the bases from validation and test
poses and seeds them with a half turn; here they are selected only from training poses and seeded with the identity.
The published behaviour is ``variant="official"``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from ...bench.contracts import Clip, FloatArray, HeadPose

IDENTITY = (1.0, 0.0, 0.0, 0.0)
HALF_TURN = (0.0, 0.0, 0.0, 1.0)
"""Real part first: half a turn about z. The published code intended the identity, with the real part last."""

DEFAULT_COUNT = 16
DISTINCT_ANGLE = np.radians(0.25)
"""Rotations nearer than this, in radians, count as equal: a tenth of the jaw's smallest visible motion."""

TGA_TEST_STRIDE = 16
"""The published code takes every 16th test frame: with 16 cameras, each timestep once."""


def leaks(variant: str) -> tuple[str, ...]:
    """Description of the leak of test data, for records of results."""
    return ("jaw bases drawn from held-out poses (published behaviour)",) if variant == "official" else ()


def jaw_quaternions(poses: Sequence[HeadPose]) -> FloatArray:
    """(N, 4) unit quaternions, real part first, of the poses' jaw rotations."""
    rotations = Rotation.from_rotvec(np.array([pose.jaw for pose in poses], dtype=np.float64).reshape(-1, 3))
    return rotations.as_quat()[:, [3, 0, 1, 2]]


def farthest_quaternions(
    candidates: FloatArray, seed: Sequence[float], count: int, *, tolerance: float = 0.0
) -> FloatArray:
    """Greedy farthest-point sampling by 1 - |<p, q>|, starting with ``seed``.

    Parameters
    ----------
    candidates : FloatArray
        (N, 4) unit quaternions, real part first.
    seed : Sequence[float]
        (4,) the first choice, included in ``count``.
    tolerance : float
        Stop when no candidate is farther than this from the chosen ones.

    Returns
    -------
    FloatArray
        (n, 4), n at most ``count``: fewer if there are fewer distinct candidates.
    """
    chosen = [np.asarray(seed, dtype=np.float64)]
    nearest = 1 - np.abs(candidates @ chosen[0][:, None])[:, 0]
    while len(chosen) < count and nearest.size and nearest.max() > tolerance:
        chosen.append(candidates[nearest.argmax()])
        nearest = np.minimum(nearest, 1 - np.abs(candidates @ chosen[-1][:, None])[:, 0])
    return np.array(chosen)


def jaw_bases(
    clip: Clip, count: int = DEFAULT_COUNT, *, variant: Literal["paper", "official"] = "paper"
) -> FloatArray:
    """Jaw bases of a clip, (n, 4) unit quaternions with the real part first, n <= ``count``.

    There are fewer than ``count`` if the performance has fewer jaw rotations that differ by more than
    `DISTINCT_ANGLE`.

    Parameters
    ----------
    variant : Literal['paper', 'official']
        "official" reproduces the published code: candidates are the poses of all novel-view frames
        and of every 16th self-reenactment frame (**a leak of the test signal**), seeded with
        `HALF_TURN`.
    """
    if variant == "official":
        test = sorted(clip.splits["self_reenactment"], key=lambda key: (key.timestep, key.camera))
        keys = [*sorted(clip.splits["novel_view"]), *test[::TGA_TEST_STRIDE]]
        candidates = jaw_quaternions([clip.poses[key.timestep] for key in keys])
        return farthest_quaternions(candidates, HALF_TURN, count)
    timesteps = sorted({key.timestep for key in clip.splits["train"]})
    candidates = jaw_quaternions([clip.poses[timestep] for timestep in timesteps])
    # |<p, q>| is the cosine of half the angle between two rotations.
    tolerance = 1 - np.cos(DISTINCT_ANGLE / 2)
    return farthest_quaternions(candidates, IDENTITY, count, tolerance=tolerance)


def jaw_weights(quaternions: FloatArray, bases: FloatArray) -> FloatArray:
    """(N, n) weights of jaw rotations on the bases: |<q, q_i>| / sum_j |<q, q_j>|; rows sum to 1.

    They hardly depend on the pose: the cosine of half an angle a is 1 - a^2 / 8, so for angles up to 0.2 rad from the bases all
    weights lie within 0.5 % of 1 / n.

    Parameters
    ----------
    quaternions : FloatArray
        (N, 4) unit quaternions, real part first.
    bases : FloatArray
        (n, 4) output of `jaw_bases`.
    """
    likeness = np.abs(quaternions @ bases.T)
    return likeness / likeness.sum(axis=1, keepdims=True)
