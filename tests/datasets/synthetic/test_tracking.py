"""Stored poses are as far from the exact ones as their level says, in the way that trackers are wrong."""

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


def test_zero_noise_changes_nothing(poses):
    assert with_tracking_noise(poses, 0.0, 1) == poses


def test_noise_is_the_stated_fraction_of_each_deviation(poses):
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
    def track(level, seed=3):
        return with_tracking_error(exact, performed, geometry.translation, geometry.head, shape, level, seed)

    return track


@pytest.fixture(scope="module")
def distances(geometry, shape, exact):
    """(T, V) millimetres between tracked and exact vertices."""
    model = HeadModel(geometry.head, dtype=torch.float64)

    def vertices(sequences):
        poses = [pose for each in sequences.values() for pose in each]
        return model(shape=torch.from_numpy(shape), **model.pose_arguments(poses)).numpy()

    there = vertices(exact)
    return lambda tracked: 1e3 * np.linalg.norm(vertices(tracked) - there, axis=2)


def test_level_zero_is_exact(track, exact):
    assert track(0.0) == exact


def test_level_one_is_as_far_off_as_trackers_are(track, distances, geometry):
    off = distances(track(1.0))
    skin = np.setdiff1d(region(geometry.head, "face"), region(geometry.head, "lips"))
    assert 0.5 < off[:, skin].mean() < 1.0
    assert 2.0 < np.sqrt((off[:, region(geometry.head, "lips")] ** 2).mean()) < 3.0
    assert off.max() < 15.0


def test_half_the_level_is_half_the_error(track, distances):
    assert distances(track(0.5)).mean() == pytest.approx(0.5 * distances(track(1.0)).mean(), rel=0.03)


def test_expressions_shrink(track, exact):
    true, found = (
        np.concatenate([[pose.expression for pose in each] for each in poses.values()])
        for poses in (exact, track(1.0))
    )
    assert 0.5 < (true * found).sum() / (true * true).sum() < 0.95


def test_drift_persists_within_a_sequence(track, exact):
    """The error of the head's position, which no expression causes, resembles that of the timestep before."""
    for name in SEQUENCES:
        off = np.array([a.translation - b.translation for a, b in zip(track(1.0)[name], exact[name])])
        off = np.concatenate(
            [off, [a.rotation - b.rotation for a, b in zip(track(1.0)[name], exact[name])]], 1
        )
        off -= off.mean(0)
        assert (off[1:] * off[:-1]).sum() / (off * off).sum() > 0.35


def test_a_seed_gives_the_same_poses_and_another_others(track):
    same = [[getattr(pose, f).tolist() for f in FIELDS if f != "eyelids"] for pose in track(1.0)["FREE"]]
    again = [[getattr(pose, f).tolist() for f in FIELDS if f != "eyelids"] for pose in track(1.0)["FREE"]]
    assert same == again
    assert track(1.0, seed=4)["FREE"][0].jaw.tolist() != track(1.0)["FREE"][0].jaw.tolist()
