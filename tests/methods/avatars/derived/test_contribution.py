"""Contributions against the dense compositing sum, written out in float64."""

import numpy as np
import torch

from headbench.methods.avatars.derived.recipes import contributions, most_contributing
from headbench.methods.avatars.harmonics import squared_contribution, training_views
from headbench.methods.shared.rendering import PosedSplats, view_of
from headbench.methods.splats import rasterize


class Ball:
    """Splats in front of the toy cameras, whatever the pose."""

    def __init__(self, count):
        rng = np.random.default_rng(5)
        quats = rng.standard_normal((count, 4))
        self.posed = PosedSplats(
            (0.05 * rng.standard_normal((count, 3))).astype(np.float32),
            (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
            np.exp(-4.5 + 0.4 * rng.standard_normal((count, 3))).astype(np.float32),
            rng.uniform(0.05, 0.95, count).astype(np.float32),
            None,
        )

    def splats(self, pose, camera=None):
        return self.posed


def test_contributions_are_weights_of_splats_coloured_alone(clip):
    ball, views = Ball(20), training_views(clip, 2)
    found = contributions(ball, views)
    # Independent: splat i painted white and all others black, without gradients, in the float64 reference.
    expected = torch.zeros(20, dtype=torch.float64)
    values = [torch.from_numpy(v).double() for v in vars(ball.posed).values() if v is not None]
    for camera, _ in views:
        view = view_of(camera, "cpu")
        for i in range(20):
            colors = torch.zeros(20, 1, dtype=torch.float64)
            colors[i] = 1
            cameras = (view.world_to_camera.double(), view.K.double(), camera.width, camera.height)
            expected[i] += rasterize(*values, colors, *cameras, backend="reference").image.sum()
    torch.testing.assert_close(found.double(), expected, rtol=2e-3, atol=2e-3)
    assert float(expected.max()) > 10 * float(expected.min())


def test_the_most_contributing_stay_in_order():
    weights = torch.tensor([3.0, 0.0, 5.0, 5.0, 1.0])
    assert most_contributing(weights, 0.6).tolist() == [0, 2, 3]
    assert most_contributing(weights, 1.0).tolist() == [0, 1, 2, 3, 4]
    assert most_contributing(weights, 0.01).tolist() == [2]


def test_views_are_of_training_alone_and_spread(clip):
    cameras = {clip.cameras[key.camera].id for key in clip.splits["train"]}
    views = training_views(clip, 5)
    assert len(views) == 5
    assert {camera.id for camera, _ in views} <= cameras
    assert len(training_views(clip, 10_000)) == len(clip.splits["train"])


def test_squared_contributions_are_mean_squares_of_weights(clip):
    """Independent: splat i painted white and all others black, in the float64 reference."""
    ball = Ball(12)
    ((camera, _),) = training_views(clip, 1)
    generator = torch.Generator().manual_seed(0)
    found = torch.stack([squared_contribution(ball.posed, camera, generator) for _ in range(400)]).mean(0)
    values = [torch.from_numpy(v).double() for v in vars(ball.posed).values() if v is not None]
    view = view_of(camera, "cpu")
    cameras = (view.world_to_camera.double(), view.K.double(), camera.width, camera.height)
    colors = torch.eye(12, dtype=torch.float64)
    images = rasterize(*values, colors, *cameras, backend="reference").image
    expected = images.square().mean((0, 1))
    torch.testing.assert_close(found.double(), expected, rtol=0.2, atol=1e-4 * float(expected.max()))
