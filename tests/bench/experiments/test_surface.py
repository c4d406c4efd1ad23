"""Depth and normals of an avatar against surfaces whose distances and normals are known in closed form."""

import numpy as np
import pytest

from headbench.bench.contracts import Camera, TrueFrame
from headbench.bench.experiments.stability import NO_DEPTH, NO_FACE, NOT_SHOWN, normals, surface

CAMERA = Camera("c", 64, 48, np.array([[80.0, 0, 32], [0, 80, 24], [0, 0, 1]]), np.eye(4))
RAYS = np.stack([*np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5), np.ones((48, 64))], axis=2)
RAYS = RAYS @ np.linalg.inv(CAMERA.K).T


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
    return {check.name: check.value for check in surface(depth, truth(true), CAMERA)}


def test_normals_are_those_of_a_ball():
    depth, expected = ball()
    found = normals(depth, CAMERA)
    near = np.isfinite(found).all(axis=2) & (expected[..., 2] < -0.7)
    assert near.sum() > 50
    angles = np.degrees(np.arccos((found * expected).sum(axis=2)[near]))
    assert angles.max() < 3.0
    tilted = 1 / (RAYS @ [0.2, -0.1, 1.0])  # of the plane 0.2 x - 0.1 y + z = 1
    expected = -np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
    np.testing.assert_allclose(normals(tilted, CAMERA), np.broadcast_to(expected, (48, 64, 3)), atol=1e-12)


def test_a_shift_is_its_length_and_keeps_the_normals_of_a_plane():
    plane = 1 / (RAYS @ [0.2, -0.1, 1.0])
    found = values(plane * 1.01, plane)
    assert found["depth face"] == pytest.approx(1000 * 0.01 * plane.mean())
    assert found["normals face"] == pytest.approx(0.0, abs=1e-5)


def test_errors_have_no_limit_and_the_largest_is_the_worst():
    depth, _ = ball()
    near, far = (surface(depth + shift, truth(depth), CAMERA)[0] for shift in (0.001, 0.5))
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
    assert {check.outcome for check in surface(depth, truth(true), CAMERA)} == {("missing", reason)}
