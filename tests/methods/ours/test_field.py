"""Canonical space of the tensorial method: bounds, positions, directions, sizes."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from headbench.methods.ours.config import Lines, OursConfig, Planes
from headbench.methods.ours.field import (
    Bounds,
    CanonicalFrames,
    canonical_directions,
    initial_parameters,
    line_box,
    plane_box,
    plane_features,
    position_part,
    shade,
    shade_directions,
)
from headbench.methods.shared.binding import to_world, triangle_frames

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


def test_canonical_positions_are_world_positions_on_the_canonical_mesh():
    vertices, faces = mesh()
    frames = triangle_frames(vertices, faces)
    binding, means = torch.tensor([0, 4, 4]), torch.randn(3, 3, dtype=torch.float64, generator=GENERATOR)
    zeros, ones = torch.zeros(3, 3, dtype=torch.float64), torch.ones(3, 4, dtype=torch.float64)
    expected = to_world(frames, binding, means, zeros, ones).means
    np.testing.assert_allclose(CanonicalFrames.of(frames).positions(binding, means), expected, atol=1e-12)


def test_canonical_directions_do_not_change_when_head_and_camera_move_together():
    vertices, faces = mesh()
    canonical = CanonicalFrames.of(triangle_frames(vertices, faces))
    means = torch.randn(4, 3, dtype=torch.float64, generator=GENERATOR)
    binding, center = torch.tensor([0, 1, 2, 4]), torch.tensor([0.0, 0.0, 9.0], dtype=torch.float64)
    turn = torch.from_numpy(Rotation.from_rotvec([0.4, -1.2, 0.3]).as_matrix())
    moved = triangle_frames(vertices @ turn.T, faces)
    still = canonical_directions(canonical.turns(triangle_frames(vertices, faces)), binding, means, center)
    np.testing.assert_allclose(still, torch.nn.functional.normalize(center - means, dim=1), atol=1e-12)
    after = canonical_directions(canonical.turns(moved), binding, means @ turn.T, turn @ center)
    np.testing.assert_allclose(after, still, atol=1e-12)


def test_published_sizes():
    """The sizes the paper's files have."""
    parameters = {
        name: value for name, (value, _) in initial_parameters(OursConfig(), 80, 16, GENERATOR).items()
    }
    size = {name: value.numel() * 4 for name, value in parameters.items()}
    assert sum(b for name, b in size.items() if name.startswith("plane_")) == 4_194_304
    assert sum(b for name, b in size.items() if name.startswith("color_weight_")) == 48_128
    assert size["lines"] == 2_359_296
    assert sum(b for name, b in size.items() if name.startswith("line_")) == 166_408


def test_initial_values():
    parameters = {k: v for k, (v, _) in initial_parameters(OursConfig(), 80, 16, GENERATOR).items()}
    for name in ("plane_xy", "plane_xz", "plane_yz"):
        assert 0.099 < parameters[name].abs().max() <= 0.1
    assert not parameters["lines"].any()
    assert parameters["color_weight_0"].abs().max() <= 91**-0.5
    assert parameters["color_weight_1"].abs().max() <= 128**-0.5


def test_colour_is_the_network_on_concatenated_features_and_encoding():
    config = OursConfig(hidden=5, planes=Planes(resolution=6, channels=(3, 2, 2)), lines=Lines(enabled=False))
    parameters = {k: v.double() for k, (v, _) in initial_parameters(config, 0, 0, GENERATOR).items()}
    box = Bounds(*(torch.tensor(v, dtype=torch.float64) for v in ([-1.0, -2, -1], [1.0, 1, 3])))
    positions = torch.rand(8, 3, dtype=torch.float64, generator=GENERATOR)
    directions = torch.nn.functional.normalize(torch.randn(8, 3, dtype=torch.float64), dim=1)
    features = plane_features(parameters, box, positions)
    found = shade_directions(parameters, position_part(parameters, features), directions)

    unit = (2 * (positions - box.low) / (box.high - box.low) - 1).numpy()
    sampled = []
    for name, (a, b) in {"xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}.items():
        image = parameters[f"plane_{name}"].view(6, 6, -1).permute(2, 0, 1)[None]
        grid = torch.from_numpy(unit[:, [a, b]])[None, None]
        sampled.append(torch.nn.functional.grid_sample(image, grid, align_corners=True)[0, :, 0].T.numpy())
    d = directions.numpy()
    encoded = [d] + [f(d * 2.0**k) for k in range(4) for f in (np.sin, np.cos)]
    hidden = np.concatenate(sampled + encoded, axis=1) @ parameters["color_weight_0"].numpy().T
    out = np.maximum(hidden, 0) @ parameters["color_weight_1"].numpy().T
    expected = np.maximum(0.5 + 0.28209479177387814 * out, 0)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_allclose(shade(parameters, features, directions), expected, atol=1e-12)
