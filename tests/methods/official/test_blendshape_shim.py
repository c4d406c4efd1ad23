"""What stands in for GaussianBlendshapes' kernels: against closed forms, torch's own operators and brute force."""

import math

import numpy as np
import pytest
import torch

from headbench.datasets.head.rotations import axis_angle_to_matrix
from headbench.methods.insta.warp import squared_distances
from headbench.methods.official.shim import blendshapes as shim
from headbench.methods.official.shim import meshes
from headbench.methods.ops.harmonics import sh_basis


def draw(*shape, seed=0, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def test_turned_harmonics_have_the_values_of_before():
    rotations = axis_angle_to_matrix(draw(5, 3))
    coefficients = draw(5, 16, 3, seed=1).requires_grad_()
    turned = shim.rotate_harmonics(rotations, coefficients)
    directions = torch.nn.functional.normalize(draw(5, 3, seed=2), dim=1)
    seen = torch.einsum("pk,pkc->pc", sh_basis(torch.einsum("pij,pj->pi", rotations, directions), 3), turned)
    before = torch.einsum("pk,pkc->pc", sh_basis(directions, 3), coefficients)
    assert torch.allclose(seen, before, atol=1e-12)
    # Turning keeps each degree's length, so the gradient of half the squared length is the coefficients.
    (0.5 * turned.square().sum()).backward()
    assert torch.allclose(coefficients.grad, coefficients, atol=1e-12)
    for degree in range(4):
        part = slice(degree**2, (degree + 1) ** 2)
        assert torch.allclose(turned[:, part].norm(dim=1), coefficients[:, part].norm(dim=1), atol=1e-12)


@pytest.mark.parametrize("shape", [(4,), (4, 3), (4, 16, 3)])
@pytest.mark.parametrize(("initial", "mask"), [(True, True), (False, True), (True, False), (False, False)])
def test_blended_expressions_and_their_gradients(shape, initial, mask):
    points, count = shape[0], 7
    mean, basis = draw(*shape).requires_grad_(), draw(*shape, count, seed=1).requires_grad_()
    coefficients = draw(count, seed=2)
    added = draw(*shape, count, seed=3) if initial else None
    weights = draw(points, count, seed=4).abs() if mask else None
    found = shim.composite_blendshape(mean, basis, coefficients, added, weights)
    spread = (weights if mask else torch.ones(points, count)).reshape(points, *[1] * (len(shape) - 1), count)
    expected = mean + (((added if initial else 0.0) + basis * spread) * coefficients).sum(-1)
    assert torch.allclose(found, expected)
    outer = draw(*shape, seed=5)
    gradients = [torch.autograd.grad((value * outer).sum(), (mean, basis)) for value in (found, expected)]
    for one, other in zip(*gradients):
        assert torch.allclose(one, other)


def test_inverses_and_their_gradients():
    matrices = (torch.eye(3, dtype=torch.float64) + 0.2 * draw(6, 3, 3)).requires_grad_()
    found, expected = shim.inverse(matrices), torch.linalg.inv(matrices)
    assert torch.allclose(found, expected)
    outer = draw(6, 3, 3, seed=1)
    gradients = [torch.autograd.grad((value * outer).sum(), matrices)[0] for value in (found, expected)]
    assert torch.allclose(*gradients)


@pytest.mark.parametrize("decay", [0.0, 0.01])
def test_adam_is_torch_s(decay):
    known = torch.nn.Parameter(draw(20))
    own, mean, square = known.detach().clone(), torch.zeros(20).double(), torch.zeros(20).double()
    optimiser = torch.optim.Adam([known], lr=0.01, betas=(0.9, 0.999), eps=1e-15, weight_decay=decay)
    for step in range(1, 6):
        known.grad = draw(20, seed=step)
        optimiser.step()
        corrections = 1 - 0.9**step, math.sqrt(1 - 0.999**step)
        rate = 0.01 / corrections[0]
        shim.adam_update(0.9, 0.999, *corrections, rate, 1e-15, decay, own, known.grad.clone(), mean, square)
    assert torch.allclose(own, known.detach(), rtol=1e-12)


@pytest.fixture
def octahedron():
    vertices = 0.05 * torch.cat([torch.eye(3), -torch.eye(3)])
    faces = [[x, y, z] for x in (0, 3) for y in (1, 4) for z in (2, 5)]
    return vertices, torch.tensor(faces, dtype=torch.int32)


def test_nearest_triangles_are_those_of_brute_force(octahedron):
    vertices, faces = octahedron
    points = 0.05 * torch.nn.functional.normalize(draw(200, 3, dtype=torch.float32), dim=1)
    found = shim.nearest_triangles(vertices, faces, points, 16)
    near = (points[:, None] - vertices).norm(dim=2).min(1).values < shim.FAR
    assert 20 < near.sum() < 180
    squared = squared_distances(points, vertices[faces.long()])
    own = squared.gather(1, found.long()[:, None])[:, 0]
    assert torch.allclose(own[near], squared.min(1).values[near], atol=1e-9)
    # Far away it is a triangle of the nearest vertex.
    corner = (points[:, None] - vertices).norm(dim=2).argmin(1)
    assert (faces.long()[found.long()] == corner[:, None]).any(1)[~near].all()


def test_features_are_interpolated_on_the_nearest_triangle(octahedron):
    vertices, faces = octahedron
    weights = torch.tensor([[0.85, 0.1, 0.05], [0.8, 0.05, 0.15]])
    triangles = torch.tensor([1, 6])
    points = (weights[:, :, None] * vertices[faces.long()[triangles]]).sum(1)
    outwards = 1 + 1e-3 * torch.ones(2, 1)
    features = draw(6, 4, dtype=torch.float32)
    found = shim.nearest_features(vertices, features, faces, points * outwards, 16)
    expected = (weights[:, :, None] * features[faces.long()[triangles]]).sum(1)
    assert torch.allclose(found, expected, atol=2e-3)


def test_ids_around_a_point_and_their_shares():
    grid = torch.arange(2 * 3 * 4).view(2, 3, 4)
    # Nodes lie at -1 and 1 of each axis and evenly between: x has 4 of them, y 3, z 2.
    points = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0], [0.0, 0.5, -0.5]])
    ids, shares = shim.ids_and_weights(points, grid, True)
    assert shares.sum(1).tolist() == pytest.approx([1, 1, 1])
    blended = (ids * shares).sum(1)
    position = (points * 0.5 + 0.5) * torch.tensor([3.0, 2.0, 1.0])
    assert torch.allclose(blended, position @ torch.tensor([1.0, 4.0, 12.0]))
    assert ids[0, 0] == 0
    assert ids[1].tolist() == [23] * 8


def test_six_numbers_are_the_first_rows_of_a_rotation():
    rotations = axis_angle_to_matrix(draw(4, 3))
    six = meshes.matrix_to_rotation_6d(rotations)
    assert torch.allclose(six[:, 3:], rotations[:, 1])
    stretched = torch.cat([2 * six[:, :3], six[:, 3:] + 0.3 * six[:, :3]], dim=1)
    assert torch.allclose(meshes.rotation_6d_to_matrix(stretched), rotations)


def test_meshes_are_read_and_sampled(tmp_path):
    (tmp_path / "a.obj").write_text("# a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n")
    vertices, faces, _ = meshes.load_obj(str(tmp_path / "a.obj"))
    assert vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert faces.verts_idx.tolist() == [[0, 1, 2]]
    triangles, barycentric = shim.sample_mesh_poisson_disk(vertices.numpy(), faces.verts_idx.numpy(), 100)
    assert 80 < len(triangles) < 120
    assert barycentric.dtype == np.float32
    assert barycentric.sum(1) == pytest.approx(1)
