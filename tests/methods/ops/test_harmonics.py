"""Spherical harmonics against scipy's."""

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from headbench.methods.ops.planes import C0, coefficient_count, harmonic_colors, sh_basis


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
