"""The networks in blocks, and weighted row sums, against torch's autograd over the plain layers."""

import numpy as np
import pytest
import torch

from headbench.methods.shared import networks
from headbench.methods.shared.networks import color_network, encode_directions, offset_network, sum_rows

POINTS, HIDDEN = 23, 6


@pytest.fixture(params=[4, 23, 2048])
def block(request, monkeypatch):
    """Many blocks with a short last one, exactly one, and one that is not full."""
    monkeypatch.setattr(networks, "CPU_BLOCK", request.param)


def random(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def values_and_gradients(function, inputs, weight):
    leaves = [value.clone().requires_grad_() for value in inputs]
    result = function(*leaves)
    return [result.detach(), *torch.autograd.grad((result * weight).sum(), leaves)]


def plain_color(first, last, directions, *features):
    hidden = torch.relu(torch.cat([*features, encode_directions(directions)], dim=1) @ first.t())
    return torch.relu(0.5 + 0.28209479177387814 * (hidden @ last.t()))


def plain_offset(summed, bias_0, weight_1, bias_1, weight_2, bias_2):
    hidden = torch.relu(torch.relu(summed + bias_0) @ weight_1.t() + bias_1)
    return hidden @ weight_2.t() + bias_2


@pytest.mark.usefixtures("block")
def test_color_network_equals_autograd_over_its_layers():
    features = [random(POINTS, width, seed=width) for width in (4, 2, 3)]
    directions = torch.nn.functional.normalize(random(POINTS, 3, seed=1), dim=1)
    # Large weights, so that the outer ReLU cuts some colours.
    inputs = [random(HIDDEN, 36, seed=2), 4 * random(3, HIDDEN, seed=3), directions, *features]
    weight = random(POINTS, 3, seed=4)
    expected = values_and_gradients(plain_color, inputs, weight)
    found = values_and_gradients(lambda a, b, d, *f: color_network(a, b, f, d), inputs, weight)
    assert (expected[0] == 0).any()
    assert (expected[0] > 0).any()
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-11)


@pytest.mark.usefixtures("block")
def test_offset_network_equals_autograd_over_its_layers():
    shapes = [(POINTS, HIDDEN), (HIDDEN,), (HIDDEN, HIDDEN), (HIDDEN,), (1, HIDDEN), (1,)]
    inputs = [random(*shape, seed=number) for number, shape in enumerate(shapes)]
    weight = random(POINTS, 1, seed=9)
    expected = values_and_gradients(plain_offset, inputs, weight)
    found = values_and_gradients(offset_network, inputs, weight)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-11)


def test_no_points_give_no_values_and_zero_gradients():
    first, last = random(HIDDEN, 31).requires_grad_(), random(3, HIDDEN).requires_grad_()
    colors = color_network(first, last, (random(0, 4),), random(0, 3))
    assert colors.shape == (0, 3)
    colors.sum().backward()
    assert not first.grad.any()
    assert not last.grad.any()


def test_row_sums_equal_a_dense_product():
    table, weights = random(9, 5), random(POINTS, 4, seed=1)
    rows = torch.randint(0, 9, (POINTS, 4), generator=torch.Generator().manual_seed(2))

    def dense(table, weights):
        # Row numbers repeat within a point: contributions to one table row add up.
        spread = torch.zeros(POINTS, 9, dtype=torch.float64).scatter_add(1, rows, weights)
        return spread @ table

    expected = values_and_gradients(dense, [table, weights], random(POINTS, 5, seed=3))
    found = values_and_gradients(
        lambda t, w: sum_rows(t, rows, w), [table, weights], random(POINTS, 5, seed=3)
    )
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
