"""Statistics of a performance or of a tracked recording: speeds, rates, and how parameters act together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from headbench.bench.contracts import FloatArray, HeadPose
from headbench.datasets.novelty import novelty

WINDOW_SECONDS = 5.0
OPEN_DEGREES = 4.0
"""Opening of the jaw beyond its 10 % quantile from which a mouth counts as open."""
SACCADE_DEGREES = 3.0
SPAN = 0.95
"""Share of the variance of the other sequences that their span holds, see `outside_span`."""


def statistics_of(sequences: Mapping[str, Sequence[HeadPose]], rate: float) -> dict[str, float]:
    """Statistics over the sequences of one subject at ``rate`` frames a second; angles in degrees, times in seconds.

    Speeds are differences of neighbouring frames. Deviations within `WINDOW_SECONDS` are medians over windows; shorter
    sequences are one window. A recording without motion in a parameter gives NaN for ratios of it.
    """
    parts = [_angles(poses) for poses in sequences.values()]
    jaw = np.concatenate([part["jaw"] for part in parts])
    opening = np.concatenate([part["opening"] for part in parts])[:, 0]
    speeds = {
        name: np.concatenate([_speed(part[name], rate) for part in parts])
        for name in ("opening", "eyes", "head")
    }
    steps = np.concatenate([_saccades(part["eyes"]) for part in parts])
    seconds = len(jaw) / rate
    expression = np.concatenate([part["expression"] for part in parts])
    deviation = expression.std(axis=0)
    spread = np.maximum(deviation, 1e-9)
    moving = ((expression - expression.mean(axis=0)) / spread)[:, deviation > 1e-6]
    paces = np.concatenate([_speed(part["expression"] / spread, rate) for part in parts])
    eigenvalues = np.linalg.eigvalsh(np.cov(expression.T))[::-1].clip(0.0)
    return {
        "jaw opening sd": float(opening.std()),
        "jaw opening 99 %": float(np.quantile(opening, 0.99)),
        "jaw speed 95 %": float(np.quantile(speeds["opening"], 0.95)),
        "jaw speed 99 %": float(np.quantile(speeds["opening"], 0.99)),
        "jaw stroke": float(
            np.median(np.concatenate([_strokes(part["opening"][:, 0], rate) for part in parts]))
        ),
        "jaw sideways 99 %": float(np.quantile(np.linalg.norm(jaw[:, 1:], axis=1), 0.99)),
        "jaw roll share": float(jaw[:, 2].std() / max(np.hypot(jaw[:, 1].std(), jaw[:, 2].std()), 1e-9)),
        "mouth open": float((opening > np.quantile(opening, 0.1) + OPEN_DEGREES).mean()),
        "gaze yaw sd": _windowed(parts, "eyes", 1, rate),
        "gaze pitch sd": _windowed(parts, "eyes", 0, rate),
        "gaze steps a minute": float(steps.sum() / seconds * 60.0),
        "gaze speed 99 %": float(np.quantile(speeds["eyes"], 0.99)),
        "head pitch sd": _windowed(parts, "head", 0, rate),
        "head yaw sd": _windowed(parts, "head", 1, rate),
        "head roll sd": _windowed(parts, "head", 2, rate),
        "head speed 50 %": float(np.quantile(speeds["head"], 0.5)),
        "head speed 99 %": float(np.quantile(speeds["head"], 0.99)),
        "participation ratio": float(eigenvalues.sum() ** 2 / (eigenvalues**2).sum()),
        "components": float(1 + np.searchsorted(np.cumsum(eigenvalues) / eigenvalues.sum(), SPAN)),
        "kurtosis": float(np.median((moving**4).mean(axis=0) / (moving**2).mean(axis=0) ** 2 - 3.0)),
        "autocorrelation time": float(
            np.median([_memory(part["expression"] / spread, rate) for part in parts])
        ),
        "still": float((paces < 0.25 * paces.mean()).mean()),
        "jaw from expression": _explained(parts),
    }


def outside_span(training: Sequence[HeadPose], held_out: Sequence[HeadPose]) -> float:
    """Share of the variance of held-out expressions, about the mean of training, outside the span of training.

    The span is that of the fewest principal components with `SPAN` of the variance of training, 1 - `SPAN` of which lies
    outside therefore.
    """
    given, other = (np.stack([pose.expression for pose in poses]) for poses in (training, held_out))
    return novelty(given, other, SPAN).outside ** 2


def _angles(poses: Sequence[HeadPose]) -> dict[str, FloatArray]:
    """(T, n) expression coefficients, and in degrees: jaw, first eye, head with neck."""
    stacked = {
        name: np.stack([getattr(pose, name) for pose in poses])
        for name in ("expression", "jaw", "eyes", "rotation", "neck")
    }
    return {
        "expression": stacked["expression"],
        "jaw": np.degrees(stacked["jaw"]),
        "opening": np.degrees(stacked["jaw"][:, :1]),
        "eyes": np.degrees(stacked["eyes"][:, :2]),
        "head": np.degrees(stacked["rotation"] + stacked["neck"]),
    }


def _speed(values: FloatArray, rate: float) -> FloatArray:
    return np.linalg.norm(np.diff(values, axis=0), axis=1) * rate


def _windowed(parts: Sequence[Mapping[str, FloatArray]], name: str, axis: int, rate: float) -> float:
    size = round(WINDOW_SECONDS * rate)
    spreads = []
    for part in parts:
        values = part[name][:, axis]
        for begin in range(0, max(len(values) - size, 0) + 1, size):
            spreads.append(values[begin : begin + size].std())
    return float(np.median(spreads))


def _saccades(eyes: FloatArray) -> FloatArray:
    """(T,) whether a step of more than `SACCADE_DEGREES` within two frames begins; one at a time."""
    moved = np.linalg.norm(eyes[2:] - eyes[:-2], axis=1) > SACCADE_DEGREES
    return moved & ~np.concatenate([[False], moved[:-1]])


def _strokes(opening: FloatArray, rate: float) -> FloatArray:
    """Seconds between 10 and 90 % of every monotone change of the opening by more than `OPEN_DEGREES`."""
    turning = np.flatnonzero(np.diff(np.sign(np.diff(opening))) != 0) + 1
    edges = [0, *turning.tolist(), len(opening) - 1]
    found = []
    for begin, end in pairwise(edges):
        change = opening[end] - opening[begin]
        if abs(change) < OPEN_DEGREES:
            continue
        part = (opening[begin : end + 1] - opening[begin]) / change
        moments = np.interp([0.1, 0.9], np.maximum.accumulate(part), np.arange(len(part)))
        found.append((moments[1] - moments[0]) / rate)
    return np.array(found)


def _memory(values: FloatArray, rate: float) -> float:
    """Seconds after which the autocorrelation of a sequence has fallen to 1/e."""
    centred = values - values.mean(axis=0)
    total = (centred**2).sum() / len(centred)
    for lag in range(1, len(centred)):
        if (centred[lag:] * centred[:-lag]).sum() / (len(centred) - lag) < total / np.e:
            return lag / rate
    return len(centred) / rate


def _explained(parts: Sequence[Mapping[str, FloatArray]]) -> float:
    """R² of a linear prediction of the jaw's opening from expression, each sequence predicted from the others."""
    errors, total = 0.0, 0.0
    every = np.concatenate([part["opening"][:, 0] for part in parts])
    for index, part in enumerate(parts):
        others = [other for i, other in enumerate(parts) if i != index]
        given = np.concatenate([other["expression"] for other in others])
        wanted = np.concatenate([other["opening"][:, 0] for other in others])
        design = np.column_stack([given, np.ones(len(given))])
        ridge = 1e-3 * np.trace(design.T @ design) / design.shape[1] * np.eye(design.shape[1])
        weights = np.linalg.solve(design.T @ design + ridge, design.T @ wanted)
        predicted = np.column_stack([part["expression"], np.ones(len(part["expression"]))]) @ weights
        errors += ((predicted - part["opening"][:, 0]) ** 2).sum()
        total += ((part["opening"][:, 0] - every.mean()) ** 2).sum()
    return float(1.0 - errors / total)
