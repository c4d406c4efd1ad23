"""Feature lines against the slow form: features for every splat, then torch's own weight-normalised layers."""

import numpy as np
import torch
from torch import nn
from torch.nn.utils.parametrizations import weight_norm

from headbench.methods.ours.field import (
    blend_lines,
    initial_line_network,
    line_offsets,
    line_position,
    normalised_weight,
)

EXPRESSIONS, JAWS, SAMPLES, CHANNELS, HIDDEN, POINTS, OUTPUTS = 5, 3, 7, 4, 6, 11, 2


def make():
    generator = torch.Generator().manual_seed(0)
    network = initial_line_network(CHANNELS, HIDDEN, OUTPUTS, generator)
    parameters = {name: value.double() for name, value in network.items()}
    # Gains away from the norms they start at, so that the normalisation matters.
    for layer in range(3):
        parameters[f"line_gain_{layer}"] = parameters[f"line_gain_{layer}"] * (1.5 + layer)
    lines = torch.randn(EXPRESSIONS + JAWS, 3, SAMPLES, CHANNELS, generator=generator, dtype=torch.float64)
    expression = torch.randn(EXPRESSIONS, generator=generator, dtype=torch.float64)
    jaw = torch.rand(JAWS, generator=generator, dtype=torch.float64)
    points = torch.rand(POINTS, 3, generator=generator, dtype=torch.float64)
    return parameters, lines, expression, jaw, points


def slow_features(lines, expression, jaw, points):
    """[e_x e_y e_z j_x j_y j_z] for each point, interpolated by numpy."""
    blended = [
        np.einsum("i,ialc->alc", expression, lines[:EXPRESSIONS]),
        np.einsum("i,ialc->alc", jaw, lines[EXPRESSIONS:]),
    ]
    rows = []
    for point in points:
        row = []
        for kind in blended:
            for axis in range(3):
                at = (SAMPLES - 1) * point[axis]
                row += [np.interp(at, np.arange(SAMPLES), kind[axis, :, c]) for c in range(CHANNELS)]
        rows.append(row)
    return np.array(rows)


def slow_network(parameters):
    """Torch's layers with its own weight normalisation."""
    layers = []
    for layer in range(3):
        direction = parameters[f"line_direction_{layer}"]
        linear = weight_norm(nn.Linear(direction.shape[1], direction.shape[0]).double(), dim=0)
        linear.parametrizations.weight.original0.data = parameters[f"line_gain_{layer}"]
        linear.parametrizations.weight.original1.data = direction
        linear.bias.data = parameters[f"line_bias_{layer}"]
        layers += [linear, nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def test_offsets_equal_the_slow_form():
    parameters, lines, expression, jaw, points = make()
    blended = blend_lines(lines, expression, jaw)
    found = line_offsets(parameters, blended, line_position(points, SAMPLES))
    features = slow_features(*(x.numpy() for x in (lines, expression, jaw, points)))
    expected = slow_network(parameters)(torch.from_numpy(features))
    np.testing.assert_allclose(found, expected.detach(), atol=1e-12)


def test_gradients_of_lines_and_network():
    parameters, lines, expression, jaw, points = make()
    names = sorted(parameters)
    position = line_position(points, SAMPLES)

    def offsets(lines, *values):
        return line_offsets(dict(zip(names, values)), blend_lines(lines, expression, jaw), position)

    inputs = [x.requires_grad_() for x in (lines, *(parameters[name] for name in names))]
    assert torch.autograd.gradcheck(offsets, inputs)


def test_zero_lines_give_one_constant_that_is_not_zero():
    parameters, lines, expression, jaw, points = make()
    blended = blend_lines(torch.zeros_like(lines), expression, jaw)
    found = line_offsets(parameters, blended, line_position(points, SAMPLES))
    assert found.std(0).max() < 1e-12
    assert found.abs().min() > 0


def test_ends_of_the_box_are_the_first_and_last_samples():
    rows, weights = line_position(torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]), SAMPLES)
    # The weight-one rows are the first sample of every line, and the last.
    assert sorted(rows[0][weights[0] == 1].tolist()) == [0, SAMPLES, 2 * SAMPLES]
    assert sorted(rows[1][weights[1] == 1].tolist()) == [SAMPLES - 1, 2 * SAMPLES - 1, 3 * SAMPLES - 1]


def test_the_network_starts_within_its_fan_in_and_with_gains_of_its_norms():
    network = initial_line_network(32, 128, 1, torch.Generator().manual_seed(1))
    direction = network["line_direction_0"]
    assert direction.shape == (128, 192)
    assert direction.abs().max() <= 192**-0.5
    assert direction.abs().max() > 0.95 * 192**-0.5
    np.testing.assert_allclose(normalised_weight(network, 0), direction, atol=1e-7)
