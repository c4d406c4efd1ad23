"""Stored poses are as far from the exact ones as their level says, in the way that trackers are wrong."""

from functools import cache

import numpy as np
import pytest
import torch

from headbench.bench.contracts import HeadPose
from headbench.datasets.head.arrays import region
from headbench.datasets.head.model import HeadModel
from headbench.datasets.synthetic.performance import perform
from headbench.datasets.synthetic.plan import load_geometry
from headbench.datasets.synthetic.tracking import FIELDS, with_tracking_error, with_tracking_noise


@pytest.fixture(scope="module")
def poses():
    rng = np.random.default_rng(0)
    return [
        HeadPose(
            "m",
            rng.normal(0, [1.0, 4.0, 0.0], 3),
            *rng.normal(0, 0.1, (3, 3)),
            rng.normal(0, 1, 6),
            np.zeros(3),
        )
        for _ in range(4000)
    ]


def test_noise_is_the_stated_fraction_of_each_deviation(poses):
    assert with_tracking_noise(poses, 0.0, 1) == poses
    noisy = with_tracking_noise(poses, 0.1, 1)
    error = np.stack([a.expression - b.expression for a, b in zip(noisy, poses)])
    np.testing.assert_allclose(error.std(0), [0.1, 0.4, 0.0], rtol=0.06, atol=1e-7)
    assert all((a.translation == 0).all() for a in noisy)
    assert with_tracking_noise(poses, 0.1, 1)[7].jaw.tolist() == noisy[7].jaw.tolist()


SEQUENCES = ("EMO-1-shout+laugh", "FREE")


@pytest.fixture(scope="module")
def geometry():
    return load_geometry("procedural")


@pytest.fixture(scope="module")
def shape(geometry):
    return np.random.default_rng(1).normal(0, 0.6, geometry.head.shape_basis.shape[2])


@pytest.fixture(scope="module")
def performed():
    return {name: perform(name, 30, seed=2).activations for name in SEQUENCES}


@pytest.fixture(scope="module")
def exact(geometry, performed):
    pose = geometry.translation.pose
    return {name: [pose(a, name, t) for t, a in enumerate(each)] for name, each in performed.items()}


@pytest.fixture(scope="module")
def track(geometry, shape, performed, exact):
    @cache
    def track(level, seed=3):
        return with_tracking_error(exact, performed, geometry.translation, geometry.head, shape, level, seed)

    return track


@pytest.fixture(scope="module")
def millimetres(geometry, shape):
    """Distances between exact and tracked vertices of the skin without lips, of the lips, and of all: (T, n) each."""
    model, parts = HeadModel(geometry.head, dtype=torch.float64), geometry.head

    def millimetres(exact, tracked):
        there, found = (
            model(
                shape=torch.from_numpy(shape), **model.pose_arguments([p for s in each.values() for p in s])
            )
            for each in (exact, tracked)
        )
        off = 1e3 * np.linalg.norm((found - there).numpy(), axis=2)
        lips = region(parts, "lips")
        return off[:, np.setdiff1d(region(parts, "face"), lips)], off[:, lips], off

    return millimetres


def test_the_level_scales_errors_of_trackers(track, millimetres, exact):
    assert track(0.0) == exact
    skin, lips, off = millimetres(exact, track(1.0))
    assert 0.5 < skin.mean() < 1.0
    assert 2.0 < np.sqrt((lips**2).mean()) < 3.0
    assert off.max() < 15.0
    assert millimetres(exact, track(0.5))[2].mean() == pytest.approx(0.5 * off.mean(), rel=0.03)


def test_expressions_shrink(track, exact):
    true, found = (np.concatenate(stacked(poses, "expression")) for poses in (exact, track(1.0)))
    assert 0.5 < (true * found).sum() / (true * true).sum() < 0.95


def test_drift_persists_within_a_sequence(track, exact):
    """The error of the head's position, which no expression causes, resembles that of the timestep before."""
    shifts, turns = (
        [found - true for found, true in zip(stacked(track(1.0), field), stacked(exact, field))]
        for field in ("translation", "rotation")
    )
    for off in map(np.hstack, zip(shifts, turns)):
        off = off - off.mean(0)
        assert (off[1:] * off[:-1]).sum() / (off * off).sum() > 0.35


def test_a_seed_gives_the_same_poses_and_another_others(track):
    one, again = track(1.0), track.__wrapped__(1.0)
    for field in FIELDS:
        if field != "eyelids":
            np.testing.assert_array_equal(stacked(one, field), stacked(again, field))
    assert track(1.0, seed=4)["FREE"][0].jaw.tolist() != one["FREE"][0].jaw.tolist()


VIDEO_SEQUENCES = ("EXP-4-lips", "EMO-2-surprise+fear", "FREE-2-recombined")


@pytest.fixture(scope="module")
def video(geometry, shape):
    """(exact, tracked) at level 1 by a tracker of videos of natural performances, every ``every``-th frame."""

    @cache
    def video(every, count=200, level=1.0):
        played = {n: perform(n, count, 2, kind="natural", every=every) for n in VIDEO_SEQUENCES}
        controls = {name: each.activations for name, each in played.items()}
        pose = geometry.translation.pose
        exact = {n: [pose(a, n, t) for t, a in enumerate(each)] for n, each in controls.items()}
        given = (exact, controls, geometry.translation, geometry.head, shape, level, 3, "video")
        return exact, with_tracking_error(*given, {n: each.step for n, each in played.items()})

    return video


def stacked(sequences, field):
    return [np.stack([getattr(pose, field) for pose in each]) for each in sequences.values()]


def test_a_tracker_of_videos_is_as_far_off_as_recorded(video, millimetres):
    skin, lips, _ = millimetres(*video(8, 60))
    assert 0.3 < skin.mean() < 0.8
    assert 0.7 < np.sqrt((lips**2).mean()) < 1.6


def test_a_tracker_of_videos_is_smooth_at_video_rate(video):
    """Third differences of tracked expressions, and power above 6 Hz: 0.02 to 0.07 and 0.001 to 0.006 in recordings."""
    _, tracked = video(1)
    jitters, powers = [], []
    for values in stacked(tracked, "expression"):
        values = values[:, values.std(axis=0) > 1e-3]
        jitters.append(np.diff(values, 3, axis=0).std(axis=0) / np.sqrt(20) / values.std(axis=0))
        spectrum = (
            np.abs(np.fft.rfft((values - values.mean(0)) * np.hanning(len(values))[:, None], axis=0)) ** 2
        )
        high = np.fft.rfftfreq(len(values), 3 / 73) > 6.0
        powers.append(spectrum[high].sum(axis=0) / spectrum[1:].sum(axis=0))
    assert 0.02 < np.median(np.concatenate(jitters)) < 0.08
    assert 0.0005 < np.median(np.concatenate(powers)) < 0.008


@pytest.mark.parametrize(
    ("field", "columns", "low", "high"),
    [
        ("eyes", [0, 1], np.radians(0.1), np.radians(0.3)),
        ("jaw", [1], np.radians(0.04), np.radians(0.1)),
        ("translation", [2], 1e-4, 3e-4),
    ],
)
def test_eyes_jaw_and_distance_jitter_as_recorded(video, field, columns, low, high):
    exact, tracked = video(1)
    off = [(a - b)[:, columns] for a, b in zip(stacked(tracked, field), stacked(exact, field))]
    jitter = np.mean([np.diff(each, 3, axis=0).std() / np.sqrt(20) for each in off])
    assert low < jitter < high
