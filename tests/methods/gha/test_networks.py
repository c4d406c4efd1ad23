"""The networks have the published sizes, and compute what the plain layers side by side do."""

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st

from headbench.methods.gha.gaussian_head import POINTS, FeatureImage, GaussianHead, SuperResolution
from headbench.methods.gha.mesh_head import MeshHead, Mlp
from headbench.methods.gha.spec import GHAConfig

GROUND = torch.tensor([1.0, 0.5, 0.25], dtype=torch.float64)
PUBLISHED_EXPRESSION = 64  # coefficients of the published face model


def plain(mlp, weights, points, condition):
    """The layers one after the other on inputs side by side."""
    inputs = points
    if condition is not None:
        inputs = torch.cat([points, condition.expand(len(points), -1)], dim=1)
    values, count = inputs, len(mlp.widths) - 1
    for layer in range(count):
        if layer and layer == len(mlp.widths) // 2:
            values = torch.cat([values, inputs], dim=1)
        values = values @ weights[f"{mlp.name}.weight_{layer}"].t() + weights[f"{mlp.name}.bias_{layer}"]
        if layer < count - 1:
            values = torch.where(values > 0, values, 0.01 * values)
    return values


def test_paper_networks_have_the_published_sizes():
    def parameter_count(shapes):
        return sum(torch.Size(shape).numel() for shape in shapes.values())

    head = GaussianHead.of(GHAConfig(), PUBLISHED_EXPRESSION)
    assert [mlp.widths for mlp in head.controllers.of_gaussians] == [
        (192, 256, 256, 32),
        (182, 128, 32),
        (91, 256, 256, 256, 256, 256, 3),
        (81, 256, 256, 3),
        (192, 256, 256, 256, 8),
        (182, 128, 128, 8),
    ]
    mesh = MeshHead.of(GHAConfig(), PUBLISHED_EXPRESSION)
    assert mesh.geometry.widths == (27, 256, 256, 256, 256, 256, 132)
    controllers = sum(parameter_count(mlp.shapes()) for mlp in head.controllers.of_gaussians)
    assert controllers == 836_153
    assert parameter_count(head.super_resolution.shapes()) == pytest.approx(322_700, abs=50)
    assert 4 * (sum(POINTS.values()) + head.config.features) == 556  # bytes of a Gaussian
    assert head.config.upscale == 4


@given(
    sizes=st.tuples(st.integers(1, 5), st.integers(0, 4), st.integers(1, 3)),
    hidden=st.lists(st.integers(1, 7), max_size=5).map(tuple),
    seed=st.integers(0, 99),
)
@settings(max_examples=40, deadline=None)
def test_a_condition_once_is_a_condition_at_every_point(sizes, hidden, seed):
    points_size, condition_size, outputs = sizes
    mlp = Mlp("m", points_size, condition_size, hidden, outputs)
    generator = torch.Generator().manual_seed(seed)
    weights = {name: value.double() for name, value in mlp.initial(generator).items()}
    points = torch.randn(6, points_size, generator=generator, dtype=torch.float64)
    condition = (
        torch.randn(condition_size, generator=generator, dtype=torch.float64) if condition_size else None
    )
    expected = plain(mlp, weights, points, condition)
    assert torch.allclose(mlp(weights, points, condition), expected, atol=1e-12)
    assert torch.allclose(mlp(weights, points, condition, 1), expected[:, :1], atol=1e-12)
    if condition is not None:  # several at once are each on its own
        several = torch.stack([condition, 2 * condition, -condition])
        expected = torch.stack([plain(mlp, weights, points, one) for one in several])
        assert torch.allclose(mlp(weights, points, several), expected, atol=1e-12)


def test_network_gradients_agree_with_finite_differences():
    mlp = Mlp("m", 3, 2, (5, 4), 2)
    generator = torch.Generator().manual_seed(0)
    weights = {name: value.double().requires_grad_() for name, value in mlp.initial(generator).items()}
    points = torch.randn(4, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    condition = torch.randn(2, generator=generator, dtype=torch.float64, requires_grad=True)

    def run(points, condition, *tensors):
        return mlp(dict(zip(weights, tensors)), points, condition)

    assert torch.autograd.gradcheck(run, (points, condition, *weights.values()))


@pytest.mark.parametrize("widths", [(4,), (5, 3), (6, 4, 3)])
def test_super_resolution_is_torchs_layers(widths):
    network = SuperResolution(3, widths)
    generator = torch.Generator().manual_seed(2)
    weights = {name: value.double() for name, value in network.initial(generator, "cpu").items()}
    features = torch.randn(5, 7, 3, generator=generator, dtype=torch.float64)
    values = features.permute(2, 0, 1)[None]
    for block in range(len(widths)):
        if block:
            values = torch.nn.Upsample(scale_factor=2, mode="bilinear", align_corners=True)(values)
        for layer in range(2):
            values = F.conv2d(values, weights[f"sr.conv_{block}_{layer}"], padding="same")
            values = torch.relu(torch.nn.InstanceNorm2d(values.shape[1])(values))
    expected = torch.sigmoid(F.conv2d(values, weights["sr.color"], weights["sr.color_bias"]))[0]
    alpha = torch.rand(5, 7, generator=generator, dtype=torch.float64)
    image = network(weights, FeatureImage(features, alpha), GROUND)
    assert image.shape == (5 * network.upscale, 7 * network.upscale, 3)
    assert torch.allclose(image, expected.permute(1, 2, 0), atol=1e-10)


@settings(max_examples=30, deadline=None)
@given(
    st.integers(1, 7),
    st.integers(1, 6),
    st.sampled_from([(4,), (5, 3), (6, 4, 3)]),
    st.booleans(),
    st.integers(0, 200),
)
def test_super_resolution_in_strips_is_that_of_the_whole_image(height, width, widths, residual, at_once):
    network = SuperResolution(3, widths, residual)
    generator = torch.Generator().manual_seed(7)
    weights = {
        name: torch.randn(shape, generator=generator, dtype=torch.float64)
        for name, shape in network.shapes().items()
    }
    features = torch.randn(height, width, 3, generator=generator, dtype=torch.float64)
    alpha = torch.rand(height, width, generator=generator, dtype=torch.float64)
    drawn = FeatureImage(features, alpha)
    expected = network(weights, drawn, GROUND)
    found = network.bounded(weights, drawn, GROUND, at_once)
    torch.testing.assert_close(found, expected, atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("widths", [(4,), (5, 3)])
def test_a_residual_starts_as_the_splatted_colours(widths):
    network = SuperResolution(6, widths, residual=True)
    generator = torch.Generator().manual_seed(4)
    weights = network.initial(generator, "cpu")
    features = torch.rand(4, 5, 6, generator=generator)
    alpha = torch.zeros(4, 5)
    planes = features[None, ..., :3].permute(0, 3, 1, 2)
    plain = torch.nn.Upsample(scale_factor=network.upscale, mode="bilinear")(planes)[0].permute(1, 2, 0)
    drawn = FeatureImage(features, torch.ones(4, 5))
    assert torch.equal(network(weights, drawn, GROUND.float()), plain)
    weights["sr.color_bias"] += 0.3
    alpha[:, 4] = 1
    image = network(weights, FeatureImage(features, alpha), GROUND.float())
    empty, clear = (
        slice(first * network.upscale, last * network.upscale) for first, last in ((0, 2), (2, 3))
    )
    assert (image[:, empty] == GROUND.float()).all()  # nothing is drawn near
    assert torch.equal(image[:, clear], plain[:, clear])
    assert (image[:, -1] != plain[:, -1]).all()


def test_zero_initialised_networks_ignore_the_condition():
    generator = torch.Generator().manual_seed(5)
    points = torch.randn(6, 3, generator=generator)
    one, other = torch.randn(2, 4, generator=generator)
    for hidden in ((), (5,), (5, 6, 7)):
        default, zeroed = (Mlp("m", 3, 4, hidden, 2, zero_condition_weights=zero) for zero in (False, True))
        weights = zeroed.initial(torch.Generator().manual_seed(6))
        assert torch.equal(zeroed(weights, points, one), zeroed(weights, points, other))
        weights = default.initial(torch.Generator().manual_seed(6))
        assert not torch.equal(default(weights, points, one), default(weights, points, other))
        resting = Mlp("m", 3, 4, hidden, 2, zero_initialised=True)
        weights = resting.initial(torch.Generator().manual_seed(6))
        assert torch.equal(resting(weights, points, one), torch.zeros(6, 2))
