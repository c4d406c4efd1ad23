"""Samples of rays: the kernel against trying every sample and every triangle; rounds against all at once."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from headbench.methods.insta import kernel
from headbench.methods.insta.marching import CanonicalSurface, Rays, Space, occupied_at
from headbench.methods.insta.occupancy import camera_rays, pixels_by_blocks

from ...datasets.head.toy import toy_head
from ..toy_clip import look_at
from .small import by_threads

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
