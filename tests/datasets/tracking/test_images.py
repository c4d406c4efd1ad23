"""Sampling of images against ramps whose values and gradients are known."""

import numpy as np

from headbench.datasets.tracking.images import FrameStack


def ramp(width, height, along, across):
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.repeat((10 + along * x + across * y)[..., None], 3, axis=2).astype(np.uint8)


def test_values_and_gradients_of_ramps():
    stack = FrameStack([ramp(20, 30, 2, 4), ramp(40, 20, 4, 2)])
    stack.filter(0.0)
    frames, places = np.array([0, 1, 1]), np.array([[7.25, 11.5], [30.0, 9.75], [3.5, 4.5]])
    values, gradients = stack.sample(frames, places)
    slopes = np.array([[2, 4], [4, 2], [4, 2]])
    wanted = 10 + (slopes * places).sum(axis=1)
    np.testing.assert_allclose(values, np.repeat(wanted[:, None], 3, axis=1) / 255, atol=5e-3)
    np.testing.assert_allclose(gradients, np.repeat(slopes[:, None], 3, axis=1) / 255, atol=2e-3)
