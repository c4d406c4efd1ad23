"""Canonical space of the tensorial method: bounds, positions, directions, sizes."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from headbench.methods.ops.mesh import triangle_frames
from headbench.methods.ops.splats import directions_to
from headbench.methods.ours.config import OursConfig
from headbench.methods.ours.field import (
    CanonicalFrames,
    blend_lines,
    initial_line_network,
    initial_parameters,
    line_box,
    normalised_weight,
    plane_box,
)

GENERATOR = torch.Generator().manual_seed(0)


def mesh(seed=0, faces=5):
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.normal(size=(3 * faces, 3))), torch.arange(3 * faces).view(faces, 3)


@pytest.mark.parametrize("variant", ["mesh", "paper"])
def test_plane_bounds(variant):
    vertices = torch.tensor([[-0.1, -0.2, -0.05], [0.08, 0.15, 0.12]])
    low, high = plane_box(vertices, variant)
    width = (-0.25, 0.25) if variant == "paper" else (-0.105, 0.085)
    np.testing.assert_allclose(low, [width[0], -0.2 - 0.005 - 0.025, -0.055], atol=1e-7)
    np.testing.assert_allclose(high, [width[1], 0.155, 0.125], atol=1e-7)


def test_line_bounds_are_the_mesh_itself_faces_included():
    vertices, _ = mesh()
    box = line_box(vertices)
    assert box.contains(vertices).all()
    assert not box.contains(vertices.amax(0)[None] + 1e-9).any()
    unit = box.unit(vertices)
    np.testing.assert_allclose([unit.min(), unit.max()], [0, 1], atol=1e-12)


def test_canonical_directions_follow_head_and_camera_together():
    vertices, faces = mesh()
    canonical = CanonicalFrames.of(triangle_frames(vertices, faces))
    means = torch.randn(4, 3, dtype=torch.float64, generator=GENERATOR)
    binding, center = torch.tensor([0, 1, 2, 4]), torch.tensor([0.0, 0.0, 9.0], dtype=torch.float64)
    turn = torch.from_numpy(Rotation.from_rotvec([0.4, -1.2, 0.3]).as_matrix())
    moved = triangle_frames(vertices @ turn.T, faces)
    still = directions_to(means, center, canonical.turns(triangle_frames(vertices, faces)), binding)
    np.testing.assert_allclose(still, torch.nn.functional.normalize(center - means, dim=1), atol=1e-12)
    after = directions_to(means @ turn.T, turn @ center, canonical.turns(moved), binding)
    np.testing.assert_allclose(after, still, atol=1e-12)


def test_published_sizes_and_initial_values():
    """The sizes the paper's files have."""
    initial = initial_parameters(OursConfig(), 80, 16, GENERATOR)
    parameters = {name: value for name, (value, _) in initial.items()}

    def size(start):
        return sum(4 * value.numel() for name, value in parameters.items() if name.startswith(start))

    assert [size(start) for start in ("plane_", "color_weight_", "lines")] == [4_194_304, 48_128, 2_359_296]
    assert size("line_") == 166_408
    for name in ("plane_xy", "plane_xz", "plane_yz"):
        assert 0.099 < parameters[name].abs().max() <= 0.1
    assert not parameters["lines"].any()
    assert parameters["color_weight_0"].abs().max() <= 91**-0.5
    assert parameters["color_weight_1"].abs().max() <= 128**-0.5


def test_the_network_starts_within_its_fan_in_with_its_norms():
    network = initial_line_network(32, 128, 1, torch.Generator().manual_seed(1))
    direction = network["line_direction_0"]
    assert direction.shape == (128, 192)
    assert direction.abs().max() <= 192**-0.5
    assert direction.abs().max() > 0.95 * 192**-0.5
    np.testing.assert_allclose(normalised_weight(network, 0), direction, atol=1e-7)


def test_lines_are_summed_by_expression_and_by_jaw_weights():
    lines, expression, jaw = torch.randn(5, 3, 4, 2), torch.randn(3), torch.tensor([0.8, 0.2])
    expected = [np.einsum("k,kalc->alc", w, each) for w, each in ((expression, lines[:3]), (jaw, lines[3:]))]
    np.testing.assert_allclose(blend_lines(lines, expression, jaw), expected, atol=1e-6)
