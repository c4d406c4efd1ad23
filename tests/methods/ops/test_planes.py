"""Row sums and planes against torch's own operators, and the smoothed encoding."""

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y
from torch.nn.functional import grid_sample

from headbench.methods.ops.planes import (
    C0,
    coefficient_count,
    encode,
    harmonic_colors,
    sample_plane,
    sh_basis,
    smoothing,
    sum_rows,
)


def real_harmonics(directions, degree):
    """Real harmonics from scipy's complex ones, m from -l to l, with the Condon-Shortley phase in Y_l^|m|."""
    x, y, z = directions.T
    theta, phi = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)
    columns = []
    for order in range(degree + 1):
        for m in range(-order, order + 1):
            value = sph_harm_y(order, abs(m), theta, phi)
            columns.append(value.real if m == 0 else np.sqrt(2) * (value.imag if m < 0 else value.real))
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_basis_equals_scipys(degree):
    directions = np.random.default_rng(degree).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    basis = sh_basis(torch.from_numpy(directions), degree)
    assert basis.shape == (50, coefficient_count(degree))
    np.testing.assert_allclose(basis, real_harmonics(directions, degree), atol=1e-12)


@pytest.mark.parametrize("degree", [0, 3])
def test_colours_are_the_clamped_sum_up_to_the_degree(degree):
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    dc, rest = rng.normal(size=(20, 3)), rng.normal(size=(20, 3, 15))
    found = harmonic_colors(*(torch.from_numpy(x) for x in (dc, rest, directions)), degree)
    count = coefficient_count(degree) - 1
    basis = real_harmonics(directions, 3)[:, 1 : 1 + count]
    expected = 0.5 + C0 * dc + np.einsum("nck,nk->nc", rest[:, :, :count], basis)
    np.testing.assert_allclose(found, np.maximum(expected, 0), atol=1e-12)


def test_harmonics_have_gradients_by_directions_too():
    rng = np.random.default_rng(2)
    directions = torch.from_numpy(rng.normal(size=(4, 3))).requires_grad_()
    dc = torch.from_numpy(rng.uniform(1, 2, size=(4, 3))).requires_grad_()
    rest = torch.from_numpy(0.1 * rng.normal(size=(4, 3, 15))).requires_grad_()

    assert torch.autograd.gradcheck(lambda *inputs: harmonic_colors(*inputs, 3), (dc, rest, directions))


POINTS = 23


def random(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def values_and_gradients(function, inputs, weight):
    leaves = [value.clone().requires_grad_() for value in inputs]
    result = function(*leaves)
    return [result.detach(), *torch.autograd.grad((result * weight).sum(), leaves)]


def check(function, definition, inputs, weight):
    """Both give the same values and gradients, which are returned."""
    expected = values_and_gradients(definition, inputs, weight)
    for one, other in zip(values_and_gradients(function, inputs, weight), expected, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-11)
    return expected


def test_row_sums_equal_a_dense_product():
    table, weights = random(9, 5), random(POINTS, 4, seed=1)
    rows = torch.randint(0, 9, (POINTS, 4), generator=torch.Generator().manual_seed(2))

    def dense(table, weights):
        # Row numbers repeat within a point: contributions to one table row add up.
        spread = torch.zeros(POINTS, 9, dtype=torch.float64).scatter_add(1, rows, weights)
        return spread @ table

    check(lambda t, w: sum_rows(t, rows, w), dense, [table, weights], random(POINTS, 5, seed=3))


RESOLUTION, CHANNELS = 9, 4


def by_grid_sample(plane, coordinates):
    image = plane.view(RESOLUTION, RESOLUTION, -1).permute(2, 0, 1)[None]
    sampled = grid_sample(
        image, coordinates[None, None], mode="bilinear", padding_mode="border", align_corners=True
    )
    return sampled[0, :, 0].T


def test_planes_are_sampled_as_by_grid_sample():
    """Values and gradients, at coordinates inside the plane and outside."""
    plane, coordinates = random(RESOLUTION**2, CHANNELS), 1.3 * random(40, 2, seed=1).clamp(-1, 1)
    weight = random(40, CHANNELS, seed=2)
    check(lambda p, c: sample_plane(p, c, RESOLUTION), by_grid_sample, [plane, coordinates], weight)


def test_smoothing_is_the_mean_encoding_of_noisy_directions():
    direction = torch.tensor([[0.3, -0.5, 0.8]], dtype=torch.float64)
    noise = torch.randn(200_000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    mean = encode(direction + 0.3 * noise).mean(0)
    factors = smoothing(0.3).double()
    np.testing.assert_allclose(factors * encode(direction)[0], mean, atol=5e-3)
    assert factors.min() == pytest.approx(np.exp(-0.5 * (8 * 0.3) ** 2))
