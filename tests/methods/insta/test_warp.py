"""The warp: what rigid motion and growth must do to it, and its parts against plain loops."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from headbench.datasets.head.rotations import axis_angle_to_matrix
from headbench.methods.insta import kernel
from headbench.methods.insta.marching import (
    Blend,
    CanonicalSurface,
    Rays,
    blended,
    canonical_from_posed,
    edge_neighbours,
    first_hits,
    nearest_triangles,
    squared_distances,
    touching,
)

from ...datasets.head.toy import toy_head


@pytest.fixture(scope="module")
def head():
    return toy_head(16)


def pieces(head):
    return torch.from_numpy(head.template), torch.from_numpy(np.asarray(head.faces, dtype=np.int64))


def carried(points, triangles, matrices, vertices, faces, blend):
    transform = blended(points, triangles, matrices, vertices[faces].mean(1), blend)
    return (transform[:, :, :3] @ points[..., None])[..., 0] + transform[:, :, 3]


@pytest.mark.parametrize("variant", ["paper", "official"])
def test_a_rigid_motion_is_undone_everywhere(head, variant):
    vertices, faces = pieces(head)
    turn = axis_angle_to_matrix(torch.tensor([0.4, -1.0, 0.3], dtype=torch.float64))
    shift = torch.tensor([0.1, 0.2, -0.3], dtype=torch.float64)
    posed = vertices @ turn.T + shift
    blend = Blend.of(head, variant)
    matrices = canonical_from_posed(vertices, posed, faces, blend)
    generator = torch.Generator().manual_seed(0)
    canonical = torch.randn(300, 3, generator=generator, dtype=torch.float64) * 0.1
    triangles = torch.randint(len(faces), (300,), generator=generator)
    back = carried(canonical @ turn.T + shift, triangles, matrices, posed, faces, blend)
    torch.testing.assert_close(back, canonical, atol=1e-12, rtol=0)


def test_a_grown_head_is_shrunk(head):
    vertices, faces = pieces(head)
    blend = Blend.of(head, "paper")
    matrices = canonical_from_posed(vertices, 1.3 * vertices, faces, blend)
    points = vertices[faces].mean(1) * 1.7
    back = carried(points, torch.arange(len(faces)), matrices, 1.3 * vertices, faces, blend)
    torch.testing.assert_close(back, points / 1.3, atol=1e-10, rtol=0)


def test_the_official_warp_scales_the_eye_region_alone(head):
    vertices, faces = pieces(head)
    matrices = canonical_from_posed(vertices, 1.3 * vertices, faces, Blend.of(head, "official"))
    scales = torch.linalg.det(matrices[:, :, :3]).pow(1 / 3)
    apart = touching(head, "lips") | touching(head, "left_ear") | touching(head, "right_ear")
    eyes = torch.from_numpy(touching(head, "eye_region") & ~apart)
    assert eyes.any()
    torch.testing.assert_close(scales[eyes], torch.full_like(scales[eyes], 1.3**-2))
    torch.testing.assert_close(scales[~eyes], torch.ones_like(scales[~eyes]))


def test_neighbours_are_those_that_share_an_edge(head):
    faces = np.asarray(head.faces)
    neighbours = edge_neighbours(faces)
    sets = [set(face) for face in faces]
    for number in range(0, len(faces), 17):
        for side, (a, b) in enumerate(((0, 1), (1, 2), (2, 0))):
            edge = {faces[number][a], faces[number][b]}
            sharing = [other for other, own in enumerate(sets) if edge <= own and other != number]
            assert neighbours[number, side] in (sharing or [-1])


def test_a_border_and_a_fan_of_three():
    assert edge_neighbours(np.array([[0, 1, 2]])).tolist() == [[-1, -1, -1]]
    # Three triangles on the edge 0-1: each has the next one as its neighbour there.
    fan = edge_neighbours(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
    assert fan[:, 0].tolist() == [1, 2, 0]


def test_the_mean_of_transforms_is_weighted_by_distance(head):
    vertices, faces = pieces(head)
    blend = Blend.of(head, "paper")
    rng = np.random.default_rng(0)
    matrices = torch.from_numpy(rng.normal(size=(len(faces), 3, 4)))
    centroids = vertices[faces].mean(1)
    point, triangle = centroids[40] + 0.02, 40
    total, weights = torch.zeros(3, 4, dtype=torch.float64), 0.0
    for face in (triangle, *(int(f) for f in blend.neighbours[triangle] if f >= 0)):
        weight = np.exp(-4 * np.linalg.norm((point - centroids[face]).numpy()))
        total, weights = total + weight * matrices[face], weights + weight
    found = blended(point[None], torch.tensor([triangle]), matrices, centroids, blend)[0]
    torch.testing.assert_close(found, total / weights)


needs_kernel = pytest.mark.skipif(
    kernel.load() is None, reason="INSTA's kernel is not installed: no C++ compiler was found"
)
SIDE = 60


def barycentric_grid():
    i, j = np.meshgrid(np.arange(SIDE + 1), np.arange(SIDE + 1), indexing="ij")
    keep = i + j <= SIDE
    u, v = i[keep] / SIDE, j[keep] / SIDE
    return np.stack([1 - u - v, u, v], axis=1)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_squared_distances_agree_with_dense_sampling(seed):
    rng = np.random.default_rng(seed)
    corners, points = rng.normal(size=(1, 3, 3)), rng.normal(size=(20, 3)) * 2
    surface = barycentric_grid() @ corners[0]
    dense = np.linalg.norm(points[:, None] - surface, axis=2).min(1)
    exact = squared_distances(torch.from_numpy(points), torch.from_numpy(corners))[:, 0].sqrt().numpy()
    spacing = np.linalg.norm(corners[0] - np.roll(corners[0], 1, axis=0), axis=1).max() / SIDE
    assert (exact <= dense + 1e-9).all()
    assert (dense <= exact + spacing).all()


def test_space_around_a_convex_edge_is_parted_along_the_bisector():
    # Two walls of a roof with its ridge along x; above the ridge all points are equally far from both.
    roof = torch.tensor(
        [[[0.0, 0, 0], [1, 0, 0], [0.5, 1, -1]], [[0.0, 0, 0], [1, 0, 0], [0.5, -1, -1]]], dtype=torch.float64
    )
    points = torch.tensor([[0.5, 0.1, 1.0], [0.5, -0.1, 1.0]], dtype=torch.float64)
    assert nearest_triangles(points, roof).triangles.tolist() == [0, 1]


@pytest.fixture(scope="module")
def surface():
    head = toy_head(16)
    return CanonicalSurface(head, torch.from_numpy(head.template).float(), backend="kernel")


@pytest.fixture(scope="module")
def posed(surface):
    rng = np.random.default_rng(3)
    moved = surface.canonical.numpy() * 1.1 + 0.004 * rng.standard_normal(surface.canonical.shape)
    return surface.pose(torch.from_numpy(moved).float())


@needs_kernel
@pytest.mark.parametrize("spread", [0.002, 0.3])
def test_the_kernel_finds_the_nearest_triangle_of_all(posed, spread):
    rng = np.random.default_rng(1)
    base = posed.vertices.numpy()[rng.integers(0, len(posed.vertices), 500)]
    points = (base + spread * rng.standard_normal(base.shape)).astype(np.float32)
    found = posed.nearest(points)
    all_of_them = squared_distances(torch.from_numpy(points).double(), posed.corners.double()).sqrt()
    least = all_of_them.min(1).values
    chosen = all_of_them.gather(1, found.triangles[:, None])[:, 0]
    assert float((chosen - least).abs().max()) < 1e-6
    assert float((found.values.double().sqrt() - least).abs().max()) < 1e-6
    reference = nearest_triangles(torch.from_numpy(points).double(), posed.corners.double())
    assert float((reference.triangles == found.triangles).double().mean()) > 0.995  # but for rounding


@needs_kernel
@pytest.mark.parametrize("away", [0.0, 0.003, 0.5])
@pytest.mark.parametrize("spread", [1e-6, 0.004, 0.02])
def test_points_together_find_what_each_finds_alone(posed, away, spread):
    rng = np.random.default_rng(4)
    middles = posed.vertices.numpy()[rng.integers(0, len(posed.vertices), 40)] * (1 + away / 0.1)
    points = (middles[:, None] + spread * rng.uniform(-1, 1, (40, 16, 3))).reshape(-1, 3).astype(np.float32)
    expected = nearest_triangles(torch.from_numpy(points).double(), posed.corners.double())
    module = kernel.load()

    def found(order):
        triangles, squared = np.empty(len(order), np.int32), np.empty(len(order), np.float32)
        module.nearest(mesh, points[order], triangles, squared, 1)
        return triangles[np.argsort(order)], squared[np.argsort(order)]

    for instruction_set in module.instruction_sets():
        mesh = module.posed(posed.surface.tree, posed.vertices.numpy(), instruction_set)
        together, apart = found(np.arange(640)), found(np.arange(640).reshape(40, 16).T.ravel())
        for one, other in zip(together, apart):
            np.testing.assert_array_equal(one, other, instruction_set)
        np.testing.assert_allclose(np.sqrt(together[1]), expected.values.sqrt(), atol=1e-6)
        if away:  # at a vertex rounding alone tells its triangles apart
            assert (together[0] == expected.triangles.numpy()).mean() > 0.99


@needs_kernel
def test_far_away_and_degenerate_meshes_are_searched_as_well():
    head = toy_head(16)
    flat = torch.from_numpy(head.template).float()
    flat[:, 2] = 0.01
    flat[head.faces[5]] = flat[head.faces[5][0]].clone()  # a triangle without area
    surface = CanonicalSurface(head, flat, backend="kernel")
    points = np.array([[0, 0, 0], [5, 5, 5], [0, 0.05, 0.01], [-100, 3, 2]], np.float32)
    least = squared_distances(torch.from_numpy(points).double(), surface.rest.corners.double()).min(1).values
    np.testing.assert_allclose(surface.rest.nearest(points).values, least, rtol=1e-5, atol=1e-12)


@needs_kernel
def test_first_hits_are_those_of_the_reference_and_of_a_plane(posed):
    rng = np.random.default_rng(2)
    origins = np.tile(np.array([[0.05, 0.02, 0.6]], np.float32), (800, 1))
    towards = 0.12 * rng.standard_normal((800, 3)) - origins
    directions = (towards / np.linalg.norm(towards, axis=1, keepdims=True)).astype(np.float32)
    found = posed.first_hit(Rays(origins, directions, np.zeros(800, np.float32)))
    exact = first_hits(
        torch.from_numpy(origins).double(), torch.from_numpy(directions).double(), posed.corners.double()
    )
    agree = (found.triangles >= 0) == (exact.triangles >= 0)
    assert float(agree.double().mean()) > 0.997  # rays along the silhouette may go either way
    both = agree & (exact.triangles >= 0)
    assert 100 < int(both.sum()) < 800
    torch.testing.assert_close(found.values[both].double(), exact.values[both], atol=2e-6, rtol=0)
    # At the distance told the ray is on the plane of the triangle told.
    at = torch.from_numpy(
        origins + directions * np.where(found.values < 9, found.values, 0)[:, None]
    ).double()
    corners = posed.corners[found.triangles.clamp_min(0)].double()
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = torch.nn.functional.normalize(normal, dim=1)
    assert float(((at - corners[:, 0]) * normal).sum(1)[both].abs().max()) < 1e-5
