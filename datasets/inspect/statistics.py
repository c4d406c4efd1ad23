"""Statistics of a capture: content of the splits and motion of the face in each sequence.

Novelty of test expressions relative to those of training.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch

from ...bench.contracts import FloatArray, FrameKey, HeadPose
from ..clip import CaptureClip
from ..head.rotations import axis_angle_to_matrix

SPAN_VARIANCE = 0.99
"""Fraction of the training variance in the span of training; the rest is regarded as tracking noise."""


class Novelty(NamedTuple):
    """Novelty of some expressions relative to those of training."""

    outside: float
    """Fraction in [0, 1] of the root mean square displacement that lies outside the span of training."""
    beyond: float
    """Fraction in [0, 1] of the expressions that leave the range of training along some direction of its span by more
    than a tenth of that range."""


def displacement_metric(basis: FloatArray) -> FloatArray:
    """(E, E) matrix from coefficients to faces whose distances are root mean squares over the vertices.

    This is exact without V x T values in memory: distances between faces are distances between coefficients in the
    metric of the basis, (V, 3, E), which is its Gram matrix divided by the number of vertices.
    """
    basis = np.asarray(basis, np.float64)
    values, vectors = np.linalg.eigh(np.einsum("vie,vif->ef", basis, basis) / len(basis))
    metric: FloatArray = vectors * np.sqrt(np.maximum(values, 0))
    return metric


def novelty(train: FloatArray, test: FloatArray, span: float = SPAN_VARIANCE) -> Novelty:
    """Compare faces, (T, E) and (N, E) as `displacement_metric` gives them; at least one of each. ``span`` is the
    fraction of the training variance in the span of training."""
    mean = train.mean(axis=0)
    _, singular, axes = np.linalg.svd(train - mean, full_matrices=False)
    variance = singular**2
    if not variance.sum() > 0:
        moved = float(np.any(np.abs(test - mean) > 0))
        return Novelty(moved, moved)
    kept = int(np.searchsorted(np.cumsum(variance) / variance.sum(), span) + 1)
    axes = axes[:kept]
    found, known = (test - mean) @ axes.T, (train - mean) @ axes.T
    total = ((test - mean) ** 2).sum()
    rest = ((test - mean - found @ axes) ** 2).sum()
    low, high = known.min(axis=0), known.max(axis=0)
    margin = 0.1 * (high - low)
    beyond = ((found < low - margin) | (found > high + margin)).any(axis=1)
    return Novelty(float(np.sqrt(rest / total)) if total > 0 else 0.0, float(beyond.mean()))


KEPT_VARIANCE = 0.95


@dataclass(frozen=True)
class SplitRow:
    """Sizes of one split."""

    split: str
    images: int
    timesteps: int
    cameras: int
    sequences: int


@dataclass(frozen=True)
class SequenceRow:
    """Motion of one sequence. Excluded timesteps are only counted."""

    sequence: str
    held_out: bool
    """Whether its timesteps test self-reenactment."""
    timesteps: int
    excluded: int
    jaw_deg: tuple[float, float, float]
    """Minimum, median and maximum opening of the jaw, degrees."""
    head_deg: float
    """Largest rotation of the head from its mean direction, degrees."""
    head_mm: float
    """Largest distance of the head from its mean position, millimetres."""
    expression_sigma: float
    """Root mean square over timesteps of the coefficients' length over sqrt(E): 1 if every coefficient has a standard
    deviation of 1."""
    largest_coefficient: float
    reach_mm: tuple[float, float]
    """Median and maximum displacement of the farthest-moving vertex by expression alone, millimetres."""


@dataclass(frozen=True, eq=False)
class ExpressionSpace:
    """Principal components of the face's displacement by expression, over the training timesteps."""

    timesteps: Sequence[int]
    """Timesteps of the capture without excluded ones."""
    held_out: np.ndarray
    """(T,) whether a timestep is held out."""
    scores_mm: FloatArray
    """(T, K) root-mean-square displacement of the face's vertices along each component."""
    explained: FloatArray
    """(K,) fraction of the training variance."""
    novelty_mm: Mapping[int, float]
    """RMS distance of the face to the nearest training face, by held-out timestep."""
    novelty: Mapping[str, Novelty]
    """Novelty of each held-out sequence against training."""

    @cached_property
    def kept(self) -> int:
        """Components that explain `KEPT_VARIANCE` of the training variance."""
        return (
            int(np.searchsorted(np.cumsum(self.explained), KEPT_VARIANCE) + 1) if len(self.explained) else 0
        )


def split_rows(clip: CaptureClip) -> list[SplitRow]:
    """Sizes of every split, and of the excluded frames if there are any."""
    parts: dict[str, Sequence[FrameKey]] = {**clip.splits}
    if clip.excluded:
        parts["excluded"] = tuple(clip.excluded)
    return [
        SplitRow(
            name,
            len(keys),
            *(len({getattr(k, of) for k in keys}) for of in ("timestep", "camera", "sequence")),
        )
        for name, keys in parts.items()
    ]


def sequence_rows(clip: CaptureClip) -> list[SequenceRow]:
    """One row per sequence, in the order of timesteps; two if its end is held out, as in a video of one camera."""
    held_out = {key.timestep for key in clip.splits.get("self_reenactment", ())}
    excluded = {key.timestep for key in clip.excluded}
    groups: dict[str, set[int]] = {}
    for key in clip.files:
        groups.setdefault(key.sequence, set()).add(key.timestep)
    rows = []
    for sequence, timesteps in sorted(groups.items(), key=lambda item: min(item[1])):
        kept = timesteps - excluded
        left_out = len(timesteps) - len(kept)
        for tested, part in ((False, kept - held_out), (True, kept & held_out)):
            if part:
                poses = [clip.poses[t] for t in sorted(part)]
                rows.append(_row(clip, sequence, tested, poses, left_out))
                left_out = 0
    return rows


def _row(
    clip: CaptureClip, sequence: str, held_out: bool, poses: Sequence[HeadPose], excluded: int
) -> SequenceRow:
    expressions = np.stack([pose.expression for pose in poses]).astype(np.float64)
    jaw = np.degrees(np.linalg.norm([pose.jaw for pose in poses], axis=1))
    places = np.stack([pose.translation for pose in poses]).astype(np.float64)
    reach = 1000 * _reach(clip, expressions)
    return SequenceRow(
        sequence=sequence,
        held_out=held_out,
        timesteps=len(poses),
        excluded=excluded,
        jaw_deg=(float(jaw.min()), float(np.median(jaw)), float(jaw.max())),
        head_deg=_largest_turn(poses),
        head_mm=float(1000 * np.linalg.norm(places - places.mean(axis=0), axis=1).max()),
        expression_sigma=float(np.sqrt((expressions**2).mean())),
        largest_coefficient=float(np.abs(expressions).max()),
        reach_mm=(float(np.median(reach)), float(reach.max())),
    )


def _largest_turn(poses: Sequence[HeadPose]) -> float:
    """Degrees between the head's rotation (root, then neck) and the mean one (chordal mean)."""
    root = axis_angle_to_matrix(torch.from_numpy(np.stack([p.rotation for p in poses]).astype(np.float64)))
    neck = axis_angle_to_matrix(torch.from_numpy(np.stack([p.neck for p in poses]).astype(np.float64)))
    turns = (root @ neck).numpy()
    u, _, vt = np.linalg.svd(turns.mean(axis=0))
    mean = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    traces = np.einsum("tij,ij->t", turns, mean)
    return float(np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1))).max())


def _reach(clip: CaptureClip, expressions: FloatArray) -> FloatArray:
    """(T,) largest displacement of a vertex by expression alone, metres."""
    basis = clip.head.expression_basis
    matrix = np.asarray(basis, dtype=np.float64).reshape(-1, basis.shape[2])
    return np.array([np.linalg.norm((matrix @ e).reshape(-1, 3), axis=1).max() for e in expressions])


def expression_space(clip: CaptureClip) -> ExpressionSpace:
    """The `ExpressionSpace` of a clip. It is computed exactly in the space of coefficients, without V x T values in memory."""
    excluded = {key.timestep for key in clip.excluded}
    test = {key.timestep for key in clip.splits.get("self_reenactment", ())}
    timesteps = [t for t in sorted(clip.poses) if t not in excluded]
    held_out = np.array([t in test for t in timesteps])
    members = clip.head.regions.get("face", np.arange(len(clip.head.template)))
    metric = displacement_metric(clip.head.expression_basis[members])
    faces = 1000 * np.stack([clip.poses[t].expression for t in timesteps]).astype(np.float64) @ metric
    train = faces[~held_out]
    centred = faces - train.mean(axis=0)
    _, singular, axes = np.linalg.svd(centred[~held_out], full_matrices=False)
    variance = singular**2
    scores = centred @ axes.T
    # The sign of a component is arbitrary; the skew is made positive.
    scores = scores * np.where((scores[~held_out] ** 3).sum(axis=0) < 0, -1.0, 1.0)
    nearest = {
        t: float(np.linalg.norm(train - face, axis=1).min())
        for t, face, new in zip(timesteps, faces, held_out)
        if new
    }
    sequences: dict[str, set[int]] = {}
    for key in clip.splits.get("self_reenactment", ()):
        sequences.setdefault(key.sequence, set()).add(key.timestep)
    new = {
        name: novelty(train, faces[[index for index, t in enumerate(timesteps) if t in members]])
        for name, members in sequences.items()
    }
    total = variance.sum()
    explained = variance / total if total > 0 else variance[:0]
    return ExpressionSpace(timesteps, held_out, scores, explained, nearest, new)
