"""What stored splats do each frame, by the kernel and by torch."""

import numpy as np
import pytest
import torch

from headbench.methods.shared.avatar_kernel import HarmonicColors, WorldTransform
from headbench.methods.shared.binding import to_world, triangle_frames


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def frames_of(dtype):
    return triangle_frames(normal(30, 3).to(dtype), torch.arange(30).view(-1, 3))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_known_shapes_and_others_are_transformed_as_defined(dtype):
    """The kernel takes float32; float64 goes the way of torch."""
    binding = torch.arange(50) % 10
    means, log_scales, quats = (normal(50, n, seed=n).to(dtype) for n in (3, 3, 4))
    carrier, frames = WorldTransform(binding, log_scales, quats), frames_of(dtype)
    for shape in ((log_scales, quats), (log_scales + 1, quats), (log_scales, 2 * quats.flip(1))):
        expected = to_world(frames, binding, means, *shape)
        for found, other in zip(carrier(frames, means, *shape), expected):
            np.testing.assert_allclose(found, other, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_both_ways_give_the_same_colours(degree, turned):
    binding, means, center = torch.arange(50) % 10, normal(50, 3), normal(3, seed=1)
    dc, rest = normal(50, 3, seed=2), normal(50, 3, (degree + 1) ** 2 - 1, seed=3)
    turns = (frames_of(torch.float64).rotation, binding) if turned else ()
    exact = HarmonicColors(dc, rest)(means, center, *turns)
    single = [value.float() if value.is_floating_point() else value for value in (means, center, *turns)]
    found = HarmonicColors(dc.float(), rest.float())(*single)
    np.testing.assert_allclose(found, exact, atol=2e-5)
    assert exact.max() > 0.5
