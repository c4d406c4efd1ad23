"""Samples of rays: the kernel against trying every sample and every triangle; rounds against all at once."""

from dataclasses import replace

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
    Space,
    blended,
    canonical_from_posed,
    edge_neighbours,
    first_hits,
    nearest_triangles,
    occupied_at,
    squared_distances,
    touching,
)
from headbench.methods.insta.occupancy import camera_rays, pixels_by_blocks

from ...datasets.head.toy import toy_head
from ..toy_clip import look_at
from .small import by_threads


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


pytestmark = pytest.mark.skipif(
    kernel.load() is None, reason="INSTA's kernel is not installed: no C++ compiler was found"
)

STEP = 0.004


def make(backend, roughness=0.003):
    head = toy_head(16)
    canonical = torch.from_numpy(head.template).float()
    surface = CanonicalSurface(head, canonical, backend=backend)
    rng = np.random.default_rng(0)
    moved = (head.template * 1.05 + roughness * rng.standard_normal(head.template.shape)).astype(np.float32)
    return surface.pose(torch.from_numpy(moved))


@pytest.fixture(scope="module")
def pair():
    return make("kernel"), make("reference")


@pytest.fixture(scope="module")
def space(pair):
    rng = np.random.default_rng(1)
    vertices = pair[0].surface.canonical.numpy()
    low, cell = vertices.min(0) - 0.03, 0.02
    size = np.ceil((vertices.max(0) + 0.03 - low) / cell).astype(int)
    occupied = rng.random(size) < 0.7
    reach = rng.uniform(-0.005, 0.03, len(pair[0].surface.faces)).astype(np.float32)
    return Space.of(reach, low.astype(np.float32), cell, occupied)


def fan(count=12):
    camera = look_at(np.array([0.1, 0.05, 0.5]), np.zeros(3), "c", count, count)
    rows, columns = np.divmod(np.arange(count * count), count)
    return camera_rays(camera, columns, rows, np.random.default_rng(2).random(count * count))


def all_samples(mesh, rays, space, most):
    """March in rounds until every ray is done; rows (ray, index), sorted."""
    first, found = np.zeros(len(rays.origins), np.int32), []
    while (first >= 0).any():
        samples = mesh.march(rays, first, STEP, most, space)
        found.append(samples)
        assert np.bincount(samples.rays, minlength=1).max(initial=0) <= most
        first = samples.next
    columns = [np.concatenate(column) for column in zip(*(part[:-1] for part in found))]
    order = np.lexsort((columns[4], columns[3]))
    return [column[order] for column in columns]


def keys_of(samples):
    """(ray, index) of each sample."""
    return set(zip(samples[3].tolist(), samples[4].tolist()))


def check_alike(one, other, least, lost=0.01):
    """At least so many samples, of which one part in ``lost`` at most may be in one of the two alone."""
    keys = keys_of(other)
    assert len(keys) > least
    # A sample at its limit of reach, at a cell's wall or between two triangles may go either way by rounding.
    assert len(keys_of(one) ^ keys) <= lost * len(keys)


# Where vertices are thrown about by millimetres the warp has folds, and points passed over may be lost.
@pytest.mark.parametrize(("roughness", "lost"), [(0.0005, 0.01), (0.003, 0.02)])
def test_the_kernel_gives_the_samples_of_the_reference(space, roughness, lost):
    pair, rays = [make(backend, roughness) for backend in ("kernel", "reference")], fan()
    ours, theirs = (all_samples(mesh, rays, space, 10_000) for mesh in pair)
    check_alike(ours, theirs, 300, lost)
    common = sorted(keys_of(ours) & keys_of(theirs))
    rows = [{key: row for row, key in enumerate(zip(p[3].tolist(), p[4].tolist()))} for p in (ours, theirs)]
    a, b = ([rows[i][key] for key in common] for i in range(2))
    same = ours[5][a] == theirs[5][b]
    assert same.mean() > 0.99
    for column in range(3):
        difference = np.abs(ours[column][a] - theirs[column][b])[same]
        assert difference.max() < 2e-5


def test_a_head_that_a_pose_enlarges_has_the_same_samples(pair, space):
    """Everything posed is 1.6 times as large, the step too: what is met in canonical space must not change."""
    surface, rays = pair[0].surface, fan()
    large = Rays((np.float32(1.6) * rays.origins).astype(np.float32), rays.directions, rays.jitter)
    first = np.zeros(len(rays.origins), np.int32)
    whole = surface.rest.march(rays, first, STEP, 10_000, space)
    found = surface.pose(1.6 * surface.canonical).march(large, first, 1.6 * STEP, 10_000, space)
    check_alike(found, whole, 300)


@pytest.mark.parametrize("most", [1, 3, 7])
def test_rounds_together_are_all_samples(pair, space, most):
    rays = fan(8)
    whole, rounds = all_samples(pair[0], rays, space, 10_000), all_samples(pair[0], rays, space, most)
    for one, other in zip(whole, rounds):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(("roughness", "lost"), [(0.0005, 0.002), (0.003, 0.03)])  # as above
@pytest.mark.parametrize("occupied", [0.02, 0.3])
def test_rays_together_have_the_samples_of_each_alone(space, occupied, roughness, lost):
    mesh = make("kernel", roughness)
    size = space.free.shape
    sparse = np.random.default_rng(5).random(size) < occupied
    thin = Space.of(space.reach, space.low, space.cell, sparse)
    camera = look_at(np.array([0.1, 0.05, 0.5]), np.zeros(3), "c", 96, 96)
    rows, columns = next(pixels_by_blocks((24, 24, 72, 72), 10_000))
    rays = camera_rays(camera, columns, rows, 0.5)
    mixed = np.random.default_rng(6).permutation(len(rows))
    together = all_samples(mesh, rays, thin, 10_000)
    alone = all_samples(mesh, Rays(*(column[mixed] for column in rays)), thin, 10_000)
    alone[3] = mixed[alone[3]]
    check_alike(together, alone, 1_000, lost)


def test_samples_are_where_they_are_said_to_be(pair, space):
    rays, mesh = fan(), pair[0]
    positions, directions, away, owner, indices, triangles = all_samples(mesh, rays, space, 64)
    points = rays.origins[owner] + ((indices + rays.jitter[owner]) * STEP)[:, None] * rays.directions[owner]
    found = mesh.nearest(points.astype(np.float32))
    np.testing.assert_allclose(away, found.values.sqrt(), atol=2e-6)
    assert (away <= mesh.reach(space)[triangles] + 1e-6).all()
    assert occupied_at(space, positions).mean() > 0.999
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-5)


def test_nothing_occupied_or_nothing_in_reach_gives_no_samples(pair, space):
    empty = replace(space, free=np.full_like(space.free, 255))
    nowhere = replace(space, reach=np.full_like(space.reach, -1))
    for mesh in pair:
        for spaces in (empty, nowhere):
            assert len(all_samples(mesh, fan(3), spaces, 8)[0]) == 0


def test_rays_along_axes_and_rays_from_within_are_marched(pair, space):
    origins = np.array([[0, 0, 0.5], [0.5, 0, 0], [0, 0.5, 0], [0, 0, 0], [9, 9, 9]], np.float32)
    directions = np.array([[0, 0, -1], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [1, 0, 0]], np.float32)
    rays = Rays(origins, directions, np.full(5, 0.5, np.float32))
    wide = replace(space, reach=np.full_like(space.reach, 0.02), free=np.zeros_like(space.free))
    ours, theirs = (all_samples(mesh, rays, wide, 10_000) for mesh in pair)
    assert set(ours[3].tolist()) == {0, 1, 2, 3}
    assert abs(len(ours[0]) - len(theirs[0])) <= 2


def test_marching_does_not_depend_on_the_number_of_threads(pair, space):
    for one, other in zip(*by_threads(lambda: all_samples(pair[0], fan(20), space, 16))):
        np.testing.assert_array_equal(one, other)


def test_free_space_is_passed_over_without_losing_a_sample(pair):
    # A thin occupied sheet in a wide free shell, under a gentle pose.
    mesh, reference = pair
    canonical = mesh.surface.canonical
    gentle = canonical * 1.02 + 0.002 * torch.sin(20 * canonical)
    low, cell = canonical.numpy().min(0) - 0.06, 0.006
    size = np.ceil((canonical.numpy().max(0) + 0.06 - low) / cell).astype(int)
    centers = low + cell * (np.stack(np.indices(size), axis=-1).reshape(-1, 3) + 0.5)
    away = mesh.surface.rest.nearest(centers).values.sqrt().numpy().reshape(size)
    sheet = Space.of(
        np.full(len(mesh.surface.faces), 0.06, np.float32), low.astype(np.float32), cell, away < 0.008
    )
    assert sheet.free.max() > 5
    ours, theirs = (
        all_samples(side.surface.pose(gentle), fan(), sheet, 10_000) for side in (mesh, reference)
    )
    check_alike(ours, theirs, 200)
