"""A natural performance has the statistics of tracked recordings."""

import numpy as np
import pytest

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

from .motion import outside_span, statistics_of

SEEDS = range(4)
NAMES = [name for name in SEQUENCES if name != HELD_OUT] + [*FREE_PARTS, SPEECH]

RECORDED = {
    # Of 22 sequences of a participant of NeRSemble tracked by Pixel3DMM (P), 25,151 poses tracked by VHAP (V), and the
    # blendshapes of two people (A); degrees, seconds. The range holds both sources, and what one person differs by.
    "jaw opening sd": (3.3, 6.4),
    "jaw opening 99 %": (19.0, 29.0),
    "jaw speed 95 %": (27.0, 60.0),
    "jaw speed 99 %": (68.0, 123.0),
    "jaw stroke": (0.20, 0.30),
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
    "head speed 50 %": (2.0, 5.0),
    "head speed 99 %": (60.0, 90.0),
    "participation ratio": (7.0, 15.0),
    "components": (15.0, 31.0),
    "kurtosis": (-0.5, 1.0),
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
