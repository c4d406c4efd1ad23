"""Stability measures against hand-made frames, and limits against their statement."""

from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest

from headbench.bench.contracts import Camera, Frame, TrueFrame
from headbench.bench.experiments.stability import (
    NO_DEPTH,
    NO_FACE,
    NOT_SHOWN,
    Limits,
    Measures,
    judge,
    measure,
    normals,
    surface,
    typical,
)

FRONT = Camera("c", 64, 48, np.array([[80.0, 0, 32], [0, 80, 24], [0, 0, 1]]), np.eye(4))
RAYS = np.stack([*np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5), np.ones((48, 64))], axis=2)
RAYS = RAYS @ np.linalg.inv(FRONT.K).T


def ball(radius=0.1, distance=1.0):
    """Depth of a ball on the axis, NaN beside it, and its normals."""
    square = (RAYS**2).sum(axis=2)
    inside = distance**2 - square * (distance**2 - radius**2)
    depth = (distance - np.sqrt(np.where(inside > 0, inside, np.nan))) / square
    return depth, (depth[..., None] * RAYS - [0, 0, distance]) / radius


def truth(depth):
    face = np.isfinite(depth)
    picture, mask = np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64), np.uint8)
    return TrueFrame(picture, mask, face, np.where(face, depth, np.inf))


def values(depth, true):
    return {check.name: check.value for check in surface(depth, truth(true), FRONT)}


def test_normals_are_those_of_a_ball():
    depth, expected = ball()
    found = normals(depth, FRONT)
    near = np.isfinite(found).all(axis=2) & (expected[..., 2] < -0.7)
    assert near.sum() > 50
    angles = np.degrees(np.arccos((found * expected).sum(axis=2)[near]))
    assert angles.max() < 3.0
    tilted = 1 / (RAYS @ [0.2, -0.1, 1.0])  # of the plane 0.2 x - 0.1 y + z = 1
    expected = -np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
    np.testing.assert_allclose(normals(tilted, FRONT), np.broadcast_to(expected, (48, 64, 3)), atol=1e-12)


def test_a_shift_is_its_length_and_keeps_the_normals_of_a_plane():
    plane = 1 / (RAYS @ [0.2, -0.1, 1.0])
    found = values(plane * 1.01, plane)
    assert found["depth face"] == pytest.approx(1000 * 0.01 * plane.mean())
    assert found["normals face"] == pytest.approx(0.0, abs=1e-5)


def test_errors_have_no_limit_and_the_largest_is_the_worst():
    depth, _ = ball()
    near, far = (surface(depth + shift, truth(depth), FRONT)[0] for shift in (0.001, 0.5))
    assert near.passed
    assert far.passed
    assert far.worst_first < near.worst_first


def test_what_is_not_shown_does_not_count():
    depth, _ = ball()
    half = depth.copy()
    half[:, :32] = np.nan
    assert values(half, depth)["depth face"] == 0.0


@pytest.mark.parametrize(
    ("depth", "true", "reason"),
    [
        (None, np.ones((48, 64)), NO_DEPTH),
        (np.ones((48, 64)), np.full((48, 64), np.nan), NO_FACE),
        (np.full((48, 64), np.nan), np.ones((48, 64)), NOT_SHOWN),
    ],
)
def test_what_cannot_be_measured_has_a_reason(depth, true, reason):
    assert {check.outcome for check in surface(depth, truth(true), FRONT)} == {("missing", reason)}


CAMERA = Camera("c", 40, 20, np.array([[50.0, 0, 20], [0, 50, 10], [0, 0, 1]]), np.eye(4))


def frame(alpha):
    return Frame(np.zeros((*alpha.shape, 3), np.float32), alpha.astype(np.float32))


def splats(means, radius=0.01, opacity=0.5):
    means = np.atleast_2d(np.asarray(means, np.float32))
    scales = np.full((len(means), 3), 0.001, np.float32)
    scales[:, 1] = radius / 3
    opacities = np.broadcast_to(np.float32(opacity), len(means)).copy()
    return SimpleNamespace(means=means, scales=scales, quats=np.ones((len(means), 4)), opacities=opacities)


def test_coverage_and_translucency_of_a_frame_counted_by_hand():
    alpha = np.zeros((20, 40))
    alpha[:4, :10] = 1.0
    alpha[4, :10] = 0.5
    alpha[5, :10] = 0.04  # as good as nothing
    found = measure(frame(alpha), CAMERA)
    assert found.coverage == pytest.approx(45.4, rel=1e-5)
    assert found.translucent == pytest.approx(10 / 50)
    assert found.largest_splat is None
    assert found.mean_opacity is None


def test_the_share_of_values_that_are_no_numbers():
    broken = frame(np.zeros((20, 40)))
    assert measure(broken, CAMERA) == Measures(0.0, 0.0, 0.0)
    broken.rgb[0, 0] = np.nan, np.inf, 0.0
    assert measure(broken, CAMERA).non_finite == pytest.approx(2 / (20 * 40 * 4))
    bad = splats([0, 0, 1])
    bad.quats[0, 0] = np.nan
    assert measure(frame(np.zeros((20, 40))), CAMERA, bad).non_finite > 0


@pytest.mark.parametrize(
    ("means", "radius", "opacity", "expected"),
    [
        ([[0, 0, 1]], 0.01, 0.5, 50 * 0.01 / 20),
        ([[0, 0, 2]], 0.01, 0.5, 50 * 0.01 / 2 / 20),
        ([[0, 0, 2], [0, 0, 0.5]], 0.01, 0.5, 50 * 0.01 / 0.5 / 20),
        ([[0.45, 0, 1]], 0.1, 0.5, 5 / 20),  # 2.5 px beyond the border, radius 5 px
        ([[0, 0, -1]], 0.01, 0.5, 0.0),  # behind
        ([[5, 0, 1]], 0.01, 0.5, 0.0),  # off screen
        ([[0, 0, 1]], 0.01, 0.01, 0.0),  # not to be seen
    ],
)
def test_the_largest_splat_is_three_deviations_projected(means, radius, opacity, expected):
    found = measure(frame(np.ones((20, 40))), CAMERA, splats(means, radius, opacity))
    assert found.largest_splat == pytest.approx(expected, rel=1e-5)
    assert found.mean_opacity == pytest.approx(opacity)


STEADY = Measures(0.0, 100.0, 0.2, 0.04, 0.5)


def broken(**changes):
    return [v.measure for v in judge(replace(STEADY, **changes), STEADY, Limits()) if not v.passed]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, []),
        ({"coverage": 81.0}, []),
        ({"coverage": 79.0}, ["coverage"]),
        ({"coverage": 126.0}, ["coverage"]),
        ({"coverage": float("nan")}, ["coverage"]),
        ({"translucent": 0.29}, []),
        ({"translucent": 0.31}, ["translucent"]),
        ({"largest_splat": 0.099}, []),
        ({"largest_splat": 0.101}, ["largest_splat"]),
        ({"mean_opacity": 0.3}, ["mean_opacity"]),
        ({"mean_opacity": 0.8}, ["mean_opacity"]),
        ({"non_finite": 1e-9}, ["non_finite"]),
    ],
)
def test_each_limit_holds_on_one_side_and_breaks_on_the_other(changes, expected):
    assert broken(**changes) == expected


def test_what_cannot_be_measured_breaks_no_limit():
    verdicts = judge(Measures(0.0, 100.0, 0.2), Measures(0.0, 100.0, 0.2), Limits())
    assert [v.measure for v in verdicts] == [field.name for field in fields(Measures)]
    assert [v.value is None for v in verdicts] == [False, False, False, True, True]
    assert all(v.passed for v in verdicts)


def test_a_reference_that_shows_nothing_is_no_excuse():
    nothing = replace(STEADY, coverage=0.0)
    assert not judge(STEADY, nothing, Limits())[1].passed
    assert judge(nothing, nothing, Limits())[1].passed


def test_the_typical_frame_is_the_median_of_each_measure():
    many = [replace(STEADY, coverage=c, translucent=t) for c, t in ((1, 0.9), (2, 0.1), (9, 0.5))]
    assert typical(many) == replace(STEADY, coverage=2.0, translucent=0.5)
    assert typical([Measures(0, 1, 0)]).largest_splat is None
