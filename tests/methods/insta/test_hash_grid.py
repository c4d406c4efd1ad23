"""Hash encoding: published sizes, closed forms, and the kernel against float64."""

import numpy as np
import pytest
import torch

from headbench.methods.insta.config import InstaConfig
from headbench.methods.insta.field import Architecture
from headbench.methods.insta.hash_grid import encode, encode_reference, make_levels, table_rows


def test_the_published_grid_has_the_published_number_of_rows():
    levels = make_levels(16, 16, 2048, 18)
    assert table_rows(levels) == 3_214_536
    assert levels[0].resolution == 16
    assert levels[-1].resolution == 2048


def test_the_published_networks_have_the_published_number_of_weights():
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
    torch.testing.assert_close(encode(positions, table, [level])[:, 0], expected)


@pytest.mark.parametrize("features", [1, 2, 4, 8])
def test_kernel_values_and_gradients_are_those_of_float64(features):
    levels = small_levels()
    generator = torch.Generator().manual_seed(features)
    positions = torch.rand(700, 3, generator=generator)
    positions[:3] = torch.tensor([[0.0, 0, 0], [1, 1, 1], [0.5, 1, 0]])
    table = torch.randn(table_rows(levels), features, generator=generator).requires_grad_()
    exact = table.detach().double().requires_grad_()
    weights = torch.randn(700, 4 * features, generator=generator)
    values = encode(positions, table, levels)
    expected = encode_reference(positions.double(), exact, levels)
    # Cells are found in float32: a position times a scale of 39 is good to 5e-6 cells.
    torch.testing.assert_close(values.double(), expected, atol=5e-5, rtol=0)
    (values * weights).sum().backward()
    (expected * weights.double()).sum().backward()
    torch.testing.assert_close(table.grad.double(), exact.grad, atol=3e-4, rtol=0)


def test_the_reference_passes_gradcheck():
    levels = make_levels(2, 2, 4, 5)
    positions = torch.rand(6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    table = torch.randn(table_rows(levels), 2, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda rows: encode_reference(positions, rows, levels), (table,))


def test_gradients_do_not_depend_on_the_number_of_threads():
    levels = small_levels()
    positions = torch.rand(5000, 3, generator=torch.Generator().manual_seed(5))
    before, gradients = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            table = torch.zeros(table_rows(levels), 4, requires_grad=True)
            encode(positions, table, levels).square().add(encode(positions, table, levels)).sum().backward()
            gradients.append(table.grad)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*gradients)


def test_a_table_that_does_not_fit_its_levels_is_refused():
    with pytest.raises(ValueError, match="fit"):
        encode(torch.rand(4, 3), torch.zeros(8, 2), small_levels())
