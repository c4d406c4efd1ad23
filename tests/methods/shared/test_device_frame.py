"""What a GPU computes of a frame in few operations, on the CPU against its definitions, in float64."""

import numpy as np
import pytest
import torch

from headbench.bench.contracts import HeadPose
from headbench.datasets.head.model import HeadModel
from headbench.datasets.head.rotations import axis_angle_to_quaternion, quaternion_to_matrix
from headbench.methods.shared import device_frame
from headbench.methods.shared.binding import left_products, to_world, triangle_frames
from headbench.methods.shared.networks import encode, sh_to_rgb, sum_rows

from ...datasets.head.toy import toy_head


def numbers(seed, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    return lambda *shape: torch.randn(*shape, generator=generator, dtype=dtype)


def unit(vectors):
    return torch.nn.functional.normalize(vectors, dim=1)


def same_turn(found, expected, tolerance=1e-12):
    """Quaternions of both signs are one rotation."""
    return bool((1 - (found * expected).sum(1).abs() < tolerance).all())


def mesh(normal, count=60):
    return triangle_frames(normal(3 * count, 3), torch.arange(3 * count).view(-1, 3))


@pytest.mark.parametrize("eyelids", [False, True])
def test_posed_vertices_are_those_of_the_definition(eyelids):
    head = toy_head(eyelids=eyelids)
    model = HeadModel(head, dtype=torch.float64)
    random = np.random.default_rng(0)
    sizes = {"expression": model.expression_size, "rotation": 3, "neck": 3, "jaw": 3, "eyes": 6}
    values = {name: 0.4 * random.standard_normal(size) for name, size in sizes.items()}
    lids = random.random(2) if eyelids else None
    pose = HeadPose(head.version, **values, translation=random.standard_normal(3), eyelids=lids)
    canonical = model.canonical(torch.from_numpy(random.standard_normal(model.shape_size)))
    posed = device_frame.PosedVertices(model, canonical)
    sent = torch.from_numpy(np.concatenate([posed.numbers(pose), [7.0]]))
    expected = model(canonical=canonical, **model.pose_arguments([pose]))[0]
    np.testing.assert_allclose(posed(sent), expected, atol=1e-12)
    assert sent[posed.numbers.size :].tolist() == [7.0]


def test_frames_of_triangles_are_those_of_the_definition():
    vertices = numbers(0)(40, 3)
    faces = torch.stack(
        [torch.randperm(40, generator=torch.Generator().manual_seed(n))[:3] for n in range(300)]
    )
    found = device_frame.triangles(vertices, device_frame.corners_of(faces))
    expected = triangle_frames(vertices, faces)
    for name in ("rotation", "center", "size"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-11)
    assert same_turn(found.quaternion, expected.quaternion)
    flat = device_frame.triangles(torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), torch.tensor([0, 1, 2]))
    assert all(torch.isfinite(value).all() for value in flat)


def test_gradients_of_frames_are_those_of_the_definition():
    normal = numbers(6)
    vertices, faces = normal(40, 3), torch.arange(39).view(-1, 3).repeat(3, 1)
    weights = normal(39, 3, 3), normal(39, 3), normal(39), normal(39, 4, 4)

    def gradient(frames_of):
        leaf = vertices.clone().requires_grad_()
        rotation, center, size, quaternion = frames_of(leaf)
        products = quaternion[:, :, None] * quaternion[:, None]  # the same for both signs
        found = zip(weights, (rotation, center, size, products))
        return torch.autograd.grad(sum((weight * value).sum() for weight, value in found), leaf)[0]

    corners = device_frame.corners_of(faces)
    found = gradient(lambda leaf: device_frame.triangles(leaf, corners))
    np.testing.assert_allclose(
        found, gradient(lambda leaf: triangle_frames(leaf, faces)), rtol=1e-8, atol=1e-9
    )


def test_splats_are_in_the_world_as_defined():
    normal = numbers(1)
    frames, binding = mesh(normal), torch.arange(500) % 60
    means, log_scales, quats = normal(500, 3), normal(500, 3), normal(500, 4)
    homogeneous = torch.nn.functional.pad(means, (0, 1), value=1.0)
    found = device_frame.splats_to_world(frames, binding, homogeneous, unit(quats), log_scales.exp())
    for one, other in zip(found, to_world(frames, binding, means, log_scales, quats)):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


def test_quaternions_are_those_of_their_rotations():
    angles = torch.cat([3 * numbers(2)(300, 3), torch.pi * torch.eye(3, dtype=torch.float64)])
    expected = axis_angle_to_quaternion(angles)
    matrices = quaternion_to_matrix(expected)
    assert same_turn(device_frame.quaternions(matrices.mT.flatten(1)), expected)
    rotations, left = device_frame.quaternion_products(expected)
    np.testing.assert_allclose(rotations, matrices.flatten(1), atol=1e-12)
    np.testing.assert_allclose(left, left_products(expected).flatten(1), atol=0)


def test_the_nearest_rotation_is_that_of_the_polar_factor():
    """Blends of rotations that differ by up to 100 degrees, as joints make them."""
    normal = numbers(3)
    first = quaternion_to_matrix(unit(normal(500, 4)))
    angles = unit(normal(500, 3)) * torch.linspace(0, np.radians(100), 500, dtype=torch.float64)[:, None]
    blends = 0.5 * (first + first @ quaternion_to_matrix(axis_angle_to_quaternion(angles)))
    left, _, right = torch.linalg.svd(blends)
    found = quaternion_to_matrix(device_frame.quaternions(blends.mT.flatten(1), squarings=4))
    np.testing.assert_allclose(found, left @ right, atol=1e-6)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("turned", [False, True])
def test_harmonic_colours_are_those_of_the_definition(degree, turned):
    normal = numbers(4)
    means, center, dc = normal(200, 3), 3 * normal(3), normal(200, 3)
    rest = normal(200, 3, (degree + 1) ** 2 - 1)
    turns, binding = mesh(normal).rotation, torch.arange(200) % 60
    directions = unit(means - center)
    if turned:
        directions = (turns[binding] @ directions[:, :, None])[:, :, 0]
    along = device_frame.directions_from(means, center, *((turns, binding) if turned else ()))
    inputs = [value.requires_grad_() for value in (dc, rest, along.detach())]
    found = device_frame.shade(device_frame.coefficients_of(dc, rest), inputs[2])
    expected = sh_to_rgb(dc, rest, inputs[2], degree)
    np.testing.assert_allclose(along, directions, atol=1e-12)
    np.testing.assert_allclose(found.detach(), expected.detach(), atol=1e-10)
    weights = normal(200, 3)
    gradients = (
        torch.autograd.grad(value, inputs, weights, allow_unused=True) for value in (found, expected)
    )
    for one, other in zip(*gradients):
        assert (one is None or not one.any()) if other is None else torch.allclose(one, other, atol=1e-9)


def test_turns_layers_and_sums_are_those_of_the_definitions():
    normal = numbers(5)
    to, origin = mesh(normal).rotation, mesh(normal).rotation
    np.testing.assert_allclose(device_frame.turns_between(to, origin), to @ origin.mT, atol=1e-12)
    hidden, weights, directions = normal(50, 16), normal(27, 16), unit(normal(50, 3))
    found = device_frame.DirectionLayer(weights)(hidden, directions)
    np.testing.assert_allclose(found, hidden + encode(-directions) @ weights, atol=1e-12)
    rows = torch.randint(20, (50, 6), generator=torch.Generator().manual_seed(0))
    weights, table = normal(50, 6), normal(20, 8)
    found = device_frame.WeightedRows(rows, weights)(table)
    np.testing.assert_allclose(found, sum_rows(table, rows, weights), atol=1e-12)
