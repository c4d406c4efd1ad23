"""Landmarks cover the face evenly; influences are the published clamp of squared distances."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from headbench.methods.gha.landmarks import influences, landmark_vertices, mouth_box


def test_landmarks_are_farthest_points_of_the_face(head):
    rows = landmark_vertices(head, head.template, 30)
    assert len(np.unique(rows)) == 30
    facial = np.concatenate(
        [head.regions[n] for n in ("face", "lips", "eye_region", "nose", "left_ear", "right_ear")]
    )
    assert set(rows) <= set(facial)
    # Each is as far from those before it as any facial vertex is.
    for count in range(1, 30):
        tree = cKDTree(head.template[rows[:count]])
        reached = tree.query(head.template[rows[count]])[0]
        assert reached == pytest.approx(tree.query(head.template[facial])[0].max())


def test_no_more_landmarks_than_vertices(head):
    rows = landmark_vertices(head, head.template, 10_000)
    assert len(rows) == len(np.unique(rows)) < len(head.template)


@given(st.integers(0, 1000), st.floats(0, 0.5), st.floats(0.01, 0.5))
@settings(max_examples=30, deadline=None)
def test_influences_are_the_published_clamp(seed, near_squared, width):
    rng = np.random.default_rng(seed)
    points, landmarks = rng.normal(size=(40, 3)) * 0.6, rng.normal(size=(7, 3)) * 0.6
    far_squared = near_squared + width
    near, far = influences(torch.tensor(points), torch.tensor(landmarks), near_squared, far_squared)
    squared = cKDTree(landmarks).query(points)[0] ** 2
    expected = np.clip((far_squared - squared) / (far_squared - near_squared), 0, 1)
    weights = np.zeros((2, 40))
    for row, part in enumerate((near, far)):
        weights[row, part.rows] = part.weights
    np.testing.assert_allclose(weights[0], expected, atol=1e-9)
    np.testing.assert_allclose(weights.sum(0), 1, atol=1e-12)
    # Only where a controller has a say is it evaluated.
    assert set(near.rows.tolist()) == set(np.flatnonzero(expected > 0))
    assert set(far.rows.tolist()) == set(np.flatnonzero(expected < 1))


def test_influences_have_the_gradient_of_the_squared_distance():
    landmarks = torch.tensor([[0.0, 0, 0], [5.0, 0, 0]], dtype=torch.float64)
    points = torch.tensor([[0.35, 0.1, 0.05], [4.7, 0.2, 0.1], [0.1, 0, 0], [2, 2, 2.0]], dtype=torch.float64)

    def weights(points):
        near, far = influences(points, landmarks, 0.1, 0.25)
        return near.weights, far.weights

    assert torch.autograd.gradcheck(weights, (points.requires_grad_(),))


def test_the_mouth_box_reaches_from_the_lips_back():
    lips = np.array([[-0.3, 0.0, 0.5], [0.3, 0.1, 0.5], [0.0, -0.1, 0.9], [0.0, 0.0, 0.7]])
    center, half = mouth_box(lips)
    np.testing.assert_allclose(center, [0, 0, 0.5])
    np.testing.assert_allclose(half, [0.24, 0.08, 0.32])
