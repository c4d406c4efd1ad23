"""The field as a whole: gradients through a rendered image against float64, published sizes, the prior."""

import numpy as np
import pytest
import torch

from headbench.methods.insta import field as networks
from headbench.methods.insta import kernel
from headbench.methods.insta.field import (
    Architecture,
    Prior,
    encode,
    initial_weight,
    layer_shapes,
    make_levels,
    network,
    table_rows,
)
from headbench.methods.insta.occupancy import Marching, PosedRays, camera_rays, render_rays
from headbench.methods.insta.spec import InstaConfig

from ..toy_clip import look_at
from .small import by_threads, make_stage


@pytest.fixture(scope="module")
def stage(head):
    return make_stage(head)


def scenes_of(surface, count=2):
    camera = look_at(np.array([0.05, 0.0, 0.5]), np.zeros(3), "c", 9, 11)
    rows, columns = np.divmod(np.arange(99), 9)
    rays = camera_rays(camera, columns, rows, 0.3)
    generator = torch.Generator().manual_seed(4)
    return [PosedRays(surface.rest, torch.randn(8, generator=generator), rays) for _ in range(count)]


def test_rendered_gradients_are_those_of_float64(stage):
    config, surface, occupancy, field, mouth = stage
    marching = Marching(config.step, 5, 0.0)
    initial = {name: value.clone() for name, value in field.architecture.initial(0).items()}
    initial["table"] = initial["table"] * 2_000  # features of a trained field, not of a blank one
    weights = torch.rand(198, 5, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    results = []
    for dtype in (torch.float32, torch.float64):
        leaves = {name: value.detach().clone().to(dtype).requires_grad_() for name, value in initial.items()}
        seen = render_rays(field, leaves, scenes_of(surface), occupancy.space(), mouth, marching)
        image = torch.cat([seen.color, seen.transmittance[:, None], seen.distance[:, None]], dim=1)
        (image * weights.to(dtype)).sum().backward()
        results.append((image.detach().double(), {n: v.grad.double() for n, v in leaves.items()}))
    (image, gradients), (expected, exact) = results
    assert float(expected[:, 3].min()) < 0.5
    torch.testing.assert_close(image, expected, atol=2e-5, rtol=0)
    for name, gradient in gradients.items():
        scale = float(exact[name].abs().max())
        assert scale > 0, name
        assert float((gradient - exact[name]).abs().max()) < 2e-4 * scale, name


def test_rounds_do_not_change_the_image(stage):
    config, surface, occupancy, field, mouth = stage
    parameters = field.architecture.initial(1)
    images = [
        render_rays(
            field, parameters, scenes_of(surface, 1), occupancy.space(), mouth, Marching(config.step, n, 0.0)
        ).color
        for n in (2, 1000)
    ]
    torch.testing.assert_close(*images, atol=1e-5, rtol=0)


def test_the_expression_is_seen_at_the_mouth_alone(stage):
    config, surface, occupancy, field, mouth = stage
    parameters = field.architecture.initial(2)
    marching = Marching(config.step, 1000, 0.0)
    one, other = scenes_of(surface)
    images = [
        render_rays(field, parameters, [scene], occupancy.space(), which, marching).color
        for which in (mouth, torch.zeros_like(mouth))
        for scene in (one, other)
    ]
    changed = (images[0] - images[1]).abs().amax(1) > 1e-6
    assert 0 < int(changed.sum()) < len(changed) / 2
    assert torch.equal(images[2], images[3])


def test_the_prior_falls_with_the_distance():
    prior = Prior(2.0, 3.0, 0.01)
    values = prior(torch.tensor([0.0, 0.005, 0.03, 1.0]))
    torch.testing.assert_close(values, torch.tensor([2.0, 1.5, -1.0, -1.0]))


def test_huge_log_densities_stay_finite(stage):
    field = stage[3]
    latent = torch.full((3, 4), 500.0, requires_grad=True)
    density = field.density(latent, torch.zeros(3))
    density.sum().backward()
    assert torch.isfinite(density).all()
    assert torch.isfinite(latent.grad).all()


def test_the_published_grid_has_the_published_number_of_rows():
    levels = make_levels(16, 16, 2048, 18)
    assert table_rows(levels) == 3_214_536
    assert levels[0].resolution == 16
    assert levels[-1].resolution == 2048


def test_the_networks_have_the_published_number_of_weights():
    # The published program pads the colour network's 3 outputs to 16.
    shapes = Architecture.of(InstaConfig(), 100).shapes()
    weights = sum(int(np.prod(shape)) for name, shape in shapes.items() if name != "table")
    assert weights + 13 * 64 == 25_600


def small_levels():
    levels = make_levels(4, 4, 40, 9)
    assert levels[0].resolution ** 3 <= levels[0].rows
    assert levels[-1].resolution ** 3 > levels[-1].rows
    return levels


def test_a_linear_function_on_a_dense_level_is_reproduced():
    (level,) = make_levels(1, 9, 9, 12)
    side = level.resolution
    at = np.stack(np.unravel_index(np.arange(side**3), (side,) * 3), axis=1)[:, ::-1]  # x runs fastest
    slope = np.array([0.3, -1.2, 2.0])
    table = torch.zeros(level.rows, 1, dtype=torch.float64)
    table[: side**3, 0] = torch.from_numpy(at @ slope + 0.7)
    positions = torch.rand(500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = (positions * level.scale) @ torch.from_numpy(slope) + 0.7
    torch.testing.assert_close(encode(table, positions, [level])[:, 0], expected)


@pytest.mark.parametrize("features", [1, 2, 4, 8])
def test_kernel_values_and_gradients_are_those_of_float64(features):
    levels = small_levels()
    generator = torch.Generator().manual_seed(features)
    positions = torch.rand(700, 3, generator=generator)
    positions[:3] = torch.tensor([[0.0, 0, 0], [1, 1, 1], [0.5, 1, 0]])
    table = torch.randn(table_rows(levels), features, generator=generator).requires_grad_()
    exact = table.detach().double().requires_grad_()
    weights = torch.randn(700, 4 * features, generator=generator)
    values = encode(table, positions, levels)
    expected = encode.definition(exact, positions.double(), levels)
    # Cells are found in float32: a position times a scale of 39 is good to 5e-6 cells.
    torch.testing.assert_close(values.double(), expected, atol=5e-5, rtol=0)
    (values * weights).sum().backward()
    (expected * weights.double()).sum().backward()
    torch.testing.assert_close(table.grad.double(), exact.grad, atol=3e-4, rtol=0)


@pytest.mark.skipif(
    kernel.load() is None, reason="INSTA's kernel is not installed: no C++ compiler was found"
)
@pytest.mark.parametrize("features", [1, 2, 4, 8])
def test_every_instruction_set_encodes_to_the_same_bits(features):
    levels, module = small_levels(), kernel.load()
    rng = np.random.default_rng(features)
    positions = rng.random((77, 3), np.float32)
    positions[:2] = [[0, 0, 0], [1, 1, 1]]
    positions[2:5] = [[np.nan, 0.5, 0.5], [-3, 0.5, 0.5], [9e9, 0.5, 0.5]]
    table = rng.standard_normal((table_rows(levels), features), np.float32)
    found = {name: np.empty((77, 4 * features), np.float32) for name in ("", *module.instruction_sets())}
    for name, out in found.items():
        module.encode(positions, table, levels, out, 1, name)
        np.testing.assert_array_equal(out, found[""])
    clamped = torch.from_numpy(np.nan_to_num(positions).clip(0, 1)).double()
    expected = encode.definition(torch.from_numpy(table).double(), clamped, levels)
    np.testing.assert_allclose(found[""], expected, atol=1e-4)


def test_gradients_do_not_depend_on_the_number_of_threads():
    levels = small_levels()
    positions = torch.rand(5000, 3, generator=torch.Generator().manual_seed(5))

    def gradient():
        table = torch.zeros(table_rows(levels), 4, requires_grad=True)
        encode(table, positions, levels).square().add(encode(table, positions, levels)).sum().backward()
        return table.grad

    assert torch.equal(*by_threads(gradient))


def network_reference(inputs, constants, rows, weights):
    values = torch.cat([inputs, constants[rows]], dim=1)
    for weight in weights[:-1]:
        values = torch.relu(values @ weight.t())
    return values @ weights[-1].t()


@pytest.mark.parametrize("constants", [0, 3])
@pytest.mark.parametrize("layers", [1, 3])
def test_values_and_gradients_are_those_of_autograd(constants, layers, monkeypatch):
    monkeypatch.setattr(networks, "BLOCK", 16)  # several blocks, the last one short
    generator = torch.Generator().manual_seed(layers)
    inputs = torch.randn(53, 5, generator=generator, dtype=torch.float64)
    others = torch.randn(4, constants, generator=generator, dtype=torch.float64)
    rows = torch.randint(4, (53,), generator=generator)
    shapes = layer_shapes(5 + constants, 7, layers, 2)
    weights = [initial_weight(shape, generator).double() for shape in shapes]
    gradient = torch.randn(53, 2, generator=generator, dtype=torch.float64)
    results = []
    for function in (network, network_reference):
        leaves = [value.clone().requires_grad_() for value in (inputs, *weights)]
        output = function(leaves[0], others, rows, leaves[1:])
        output.backward(gradient)
        results.append((output.detach(), *(leaf.grad for leaf in leaves)))
    for one, other in zip(*results):
        torch.testing.assert_close(one, other, atol=1e-12, rtol=0)
