"""Plane sampling against torch's grid_sample, which it replaces."""

import numpy as np
import pytest
import torch
from torch.nn.functional import grid_sample

from headbench.methods.shared.networks import PAIRS, encode_directions, sample_plane, sample_triplane

RESOLUTION, CHANNELS = 9, 4


def make(points=40, spread=1.3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    plane = torch.randn(RESOLUTION**2, CHANNELS, generator=generator, dtype=torch.float64)
    coordinates = (torch.rand(points, 2, generator=generator, dtype=torch.float64) * 2 - 1) * spread
    return plane, coordinates


def by_grid_sample(plane, coordinates):
    image = plane.view(RESOLUTION, RESOLUTION, -1).permute(2, 0, 1)[None]
    sampled = grid_sample(
        image, coordinates[None, None], mode="bilinear", padding_mode="border", align_corners=True
    )
    return sampled[0, :, 0].T


def test_values_equal_grid_sample_inside_and_outside():
    plane, coordinates = make()
    np.testing.assert_allclose(
        sample_plane(plane, coordinates, RESOLUTION), by_grid_sample(plane, coordinates), atol=1e-12
    )


def test_gradients_equal_grid_samples():
    plane, coordinates = make(seed=1)
    weight = torch.randn(40, CHANNELS, dtype=torch.float64)
    found, expected = [], []
    for results, sample in (
        (found, lambda p, c: sample_plane(p, c, RESOLUTION)),
        (expected, by_grid_sample),
    ):
        p, c = plane.clone().requires_grad_(), coordinates.clone().requires_grad_()
        (sample(p, c) * weight).sum().backward()
        results += [p.grad, c.grad]
    np.testing.assert_allclose(found[0], expected[0], atol=1e-12)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-11)


@pytest.mark.parametrize("corner", [-1.0, 1.0])
def test_corners_of_the_plane_are_samples(corner):
    plane, _ = make()
    found = sample_plane(plane, torch.full((1, 2), corner, dtype=torch.float64), RESOLUTION)
    np.testing.assert_allclose(found[0], plane[0 if corner < 0 else -1], atol=1e-12)


def test_planes_read_their_own_coordinates_width_first():
    ramp = torch.arange(RESOLUTION, dtype=torch.float64) / (RESOLUTION - 1) * 2 - 1
    # Each plane holds (its width coordinate, its height coordinate) as two channels.
    grid = torch.stack(torch.meshgrid(ramp, ramp, indexing="xy"), dim=-1).reshape(-1, 2)
    points = torch.rand(6, 3, dtype=torch.float64) * 2 - 1
    features = torch.cat(sample_triplane({name: grid for name, _, _ in PAIRS}, points, RESOLUTION), dim=1)
    x, y, z = points.T
    np.testing.assert_allclose(features, torch.stack([x, y, x, z, y, z], dim=1), atol=1e-12)


def test_directions_are_encoded_with_identity_and_four_frequencies_without_pi():
    direction = torch.tensor([[0.3, -0.5, 0.8]], dtype=torch.float64)
    expected = [direction]
    for frequency in (1, 2, 4, 8):
        expected += [torch.sin(frequency * direction), torch.cos(frequency * direction)]
    np.testing.assert_allclose(encode_directions(direction), torch.cat(expected, dim=1))
