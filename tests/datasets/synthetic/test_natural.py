"""A natural performance has the statistics of tracked recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from headbench.bench.contracts import FloatArray, HeadPose
from headbench.datasets.inspect.statistics import novelty
from headbench.datasets.synthetic.natural import BLINK_GAP, FRAME_RATE, blinks
from headbench.datasets.synthetic.performance import (
    CONTROLS,
    EXPRESSION_CONTROLS,
    FREE_PARTS,
    HELD_OUT,
    SEQUENCES,
    SPEECH,
    frames_kept,
    perform,
    share_out,
)
from headbench.datasets.synthetic.plan import load_geometry

SEEDS = range(4)
NAMES = [name for name in SEQUENCES if name != HELD_OUT] + [*FREE_PARTS, SPEECH]

RECORDED = {
    # Of 22 sequences of a participant of NeRSemble tracked by Pixel3DMM (P), 25,151 poses tracked by VHAP (V), and the
    # blendshapes of two people (A); degrees, seconds. The range holds both sources, and what one person differs by.
    "jaw opening 99 %": (19.0, 29.0),
    "jaw speed 99 %": (68.0, 123.0),
    "jaw sideways 99 %": (5.0, 9.0),
    "jaw roll share": (0.7, 1.0),
    "mouth open": (0.27, 0.45),
    "gaze yaw sd": (1.5, 3.8),
    "gaze pitch sd": (1.5, 3.5),
    "gaze steps a minute": (40.0, 80.0),
    "gaze speed 99 %": (180.0, 280.0),
    "head pitch sd": (0.9, 1.7),
    "head yaw sd": (0.4, 1.2),
    "head roll sd": (0.3, 0.9),
    "head speed 99 %": (60.0, 90.0),
    "participation ratio": (7.0, 15.0),
    "autocorrelation time": (0.4, 0.6),
    "still": (0.0, 0.03),
    "jaw from expression": (0.5, 1.0),
    "outside FREE-1-seen": (0.07, 0.13),
    "outside FREE-2-recombined": (0.08, 0.21),
    "outside FREE-3-beyond": (0.07, 0.13),
    "outside FREE-4-speech": (0.08, 0.24),
    "controls at once": (6.0, 12.0),
}


def played(seed):
    """A performance at a video's rate, every sequence for as long as its phrases take."""
    geometry = load_geometry("procedural")
    counts = share_out(frames_kept(1, share_out(1000, "natural")) * 5 // 4, "natural")
    sequences = {name: perform(name, counts[name], seed, kind="natural").activations for name in NAMES}
    poses = {
        name: [geometry.translation.pose(controls, "900", t) for t, controls in enumerate(each)]
        for name, each in sequences.items()
    }
    return sequences, poses


def statistics(seed):
    sequences, poses = played(seed)
    found = statistics_of(poses, FRAME_RATE)
    training = [pose for name, each in poses.items() if not name.startswith(HELD_OUT) for pose in each]
    found |= {f"outside {name}": outside_span(training, poses[name]) for name in (*FREE_PARTS, SPEECH)}
    names = (*EXPRESSION_CONTROLS, "jaw_open")
    active = [[controls[name] > 0.1 for name in names] for each in sequences.values() for controls in each]
    return found | {"controls at once": float(np.sum(active, axis=1).mean())}


@pytest.fixture(scope="module")
def measured():
    return [statistics(seed) for seed in SEEDS]


@pytest.mark.parametrize("name", RECORDED)
def test_motion_is_that_of_recordings(measured, name):
    low, high = RECORDED[name]
    assert low <= np.mean([each[name] for each in measured]) <= high


def test_blinks_are_irregular_and_more_frequent_in_speech():
    time = np.arange(0.0, 1500.0, 0.01)
    rates = {}
    for kind, gap in BLINK_GAP.items():
        closed = blinks(time, time[-1], gap, np.random.default_rng(0)) > 0.5
        begins = time[np.flatnonzero(closed[1:] & ~closed[:-1])]
        rates[kind] = len(begins) / 25.0
        gaps = np.diff(begins)
        assert 0.6 < gaps.std() / gaps.mean() < 1.0
        assert 0.09 < closed.sum() * 0.01 / len(begins) < 0.13  # seconds at half height
    assert 5.0 < rates["posed"] < 11.0
    assert 18.0 < rates["speech"] < 30.0


@pytest.mark.parametrize("name", NAMES)
def test_curves_are_bounded_and_repeatable(name):
    first, again, other = (perform(name, 80, seed, kind="natural", every=4) for seed in (1, 1, 2))
    values = np.array([[a[control] for control in CONTROLS] for a in first.activations])
    assert np.isfinite(values).all()
    assert np.abs(values).max() < 1.9
    assert first.activations == again.activations
    assert first.activations != other.activations
    assert first.step == pytest.approx(4 / FRAME_RATE)


def test_every_nth_frame_is_kept():
    every = perform("FREE-2-recombined", 120, 3, kind="natural").activations
    kept = perform("FREE-2-recombined", 24, 3, kind="natural", every=5).activations
    nearest = [every[5 * t + 2] for t in range(24)]  # the middle of every five
    assert nearest == kept


@pytest.mark.parametrize("timesteps", [160, 400])
def test_the_tongue_is_labelled_in_free_alone(timesteps):
    counts = share_out(timesteps, "natural")
    assert sum(counts.values()) == timesteps
    assert set(counts) == set(NAMES)
    excluded = {
        n: perform(n, c, 5, kind="natural", every=frames_kept(timesteps, counts)).excluded
        for n, c in counts.items()
    }
    assert {name for name, frames in excluded.items() if frames} <= {"FREE-2-recombined"}


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
    moved = [part["expression"] for part in parts]
    expression = np.concatenate(moved)
    spread = np.maximum(expression.std(axis=0), 1e-9)
    paces = np.concatenate([_speed(each / spread, rate) for each in moved])
    eigenvalues = np.linalg.eigvalsh(np.cov(expression.T))[::-1].clip(0.0)
    return {
        "jaw opening 99 %": float(np.quantile(opening, 0.99)),
        "jaw speed 99 %": float(np.quantile(speeds["opening"], 0.99)),
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
        "head speed 99 %": float(np.quantile(speeds["head"], 0.99)),
        "participation ratio": float(eigenvalues.sum() ** 2 / (eigenvalues**2).sum()),
        "autocorrelation time": float(np.median([_memory(each / spread, rate) for each in moved])),
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
    designs = [np.column_stack([part["expression"], np.ones(len(part["expression"]))]) for part in parts]
    openings = [part["opening"][:, 0] for part in parts]
    errors = 0.0
    for i, (given, wanted) in enumerate(zip(designs, openings)):
        others = (
            np.concatenate(designs[:i] + designs[i + 1 :]),
            np.concatenate(openings[:i] + openings[i + 1 :]),
        )
        errors += ((given @ np.linalg.lstsq(*others, rcond=0.03)[0] - wanted) ** 2).sum()
    every = np.concatenate(openings)
    return float(1.0 - errors / ((every - every.mean()) ** 2).sum())
