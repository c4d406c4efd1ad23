"""Rays against the projection of points on them."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from headbench.bench.contracts import Camera
from headbench.methods.insta.field import Prior
from headbench.methods.insta.occupancy import (
    box_corners,
    camera_rays,
    composite,
    occupied_space,
    pixels_by_blocks,
    pixels_of_hull,
)
from headbench.methods.insta.spec import InstaConfig

from .small import make_stage

SMALL_DECAY = InstaConfig().occupancy_decay


def test_occupied_cells_are_within_their_triangles_reach(head):
    _, surface, occupancy, *_ = make_stage(head)
    rng = np.random.default_rng(0)
    chosen = rng.choice(occupancy.candidates, size=60, replace=False)
    space = occupied_space(occupancy, chosen)
    assert int(space.occupied.sum()) == 60
    cells = np.stack(np.unravel_index(np.repeat(chosen, 50), space.occupied.shape), axis=1)
    points = (space.low + space.cell * (cells + rng.random(cells.shape))).astype(np.float32)
    found = surface.rest.nearest(points)
    within = found.values.sqrt().numpy() <= space.reach[found.triangles.numpy()] + 1e-6
    # Across a concavity a corner of a cell may belong to a triangle that none of the probed points belongs to.
    assert within.mean() > 0.998


def test_candidates_are_the_shell_around_the_mesh(head):
    config, surface, occupancy, *_ = make_stage(head)
    rng = np.random.default_rng(1)
    size = occupancy.size
    points = (occupancy.low + occupancy.cell * size * rng.random((3000, 3))).astype(np.float32)
    distances = surface.rest.nearest(points).values.sqrt().numpy()
    cells = np.floor((points - occupancy.low) / occupancy.cell).astype(int).clip(0, size - 1)
    inside = np.isin(np.ravel_multi_index(cells.T, size), occupancy.candidates)
    assert inside[distances < config.shell_inside].all()
    assert not inside[distances > config.shell_outside + 2 * occupancy.cell].any()


def refreshed(head, prior, rounds=1, whole=True, occupancy=None):
    stage = make_stage(head, prior)
    occupancy = occupancy or stage.occupancy
    parameters = stage.field.architecture.initial(0)
    for iteration in range(rounds):
        what = (stage.field, parameters, torch.zeros(8), stage.mouth)
        occupancy.refresh(*what, 5, iteration, whole=whole)
    return occupancy


def test_empty_and_dense_fields_occupy_nothing_and_everything(head):
    empty = refreshed(head, Prior(-200, 0, 1))
    assert not empty.occupied.any()
    assert (empty.space().reach < 0).all()
    dense = refreshed(head, Prior(5, 0, 1))
    assert dense.occupied.all()
    before = dense.values.copy()
    refreshed(head, Prior(-200, 0, 1), occupancy=dense)
    np.testing.assert_allclose(dense.values, SMALL_DECAY * before, rtol=1e-6)


def test_a_field_that_hugs_the_mesh_leaves_a_thin_shell(head):
    thin = refreshed(head, Prior(6, 50, 0.001))
    distances = thin._distances[thin.occupied]
    assert 0.05 < thin.occupied.mean() < 0.7
    assert distances.max() < 0.012


def test_partial_refreshes_reach_every_cell(head):
    one, other = (refreshed(head, Prior(3, 0, 1), rounds=40, whole=False) for _ in range(2))
    assert np.isfinite(one.values).mean() > 0.99
    np.testing.assert_array_equal(one.values, other.values)


def some_camera(seed, width=40, height=30):
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.linalg.det(turn)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, [0.05, -0.02, 1.0]
    K = np.array([[50.0, 0.4, 18.0], [0, 60.0, 17.0], [0, 0, 1]])
    return Camera("c", width, height, K, pose)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_points_on_a_ray_project_to_the_centre_of_its_pixel(seed):
    camera = some_camera(seed)
    rows, columns = np.divmod(np.arange(40 * 30), 40)
    rays = camera_rays(camera, columns, rows, 0.5)
    np.testing.assert_allclose(np.linalg.norm(rays.directions, axis=1), 1, atol=1e-6)
    points = rays.origins.astype(np.float64) + 0.8 * rays.directions
    seen = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = seen @ camera.K.T
    np.testing.assert_allclose(pixels[:, :2] / pixels[:, 2:], np.stack([columns, rows], 1) + 0.5, atol=1e-3)
    assert (seen[:, 2] > 0).all()


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_no_point_of_the_hull_projects_outside_its_pixels(seed):
    camera = some_camera(seed)
    rng = np.random.default_rng(seed)
    corners = box_corners(rng.normal(size=(10, 3)) * 0.1, 0.02)
    weights = rng.dirichlet(np.ones(8), 200)
    seen = (weights @ corners) @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = (seen @ camera.K.T)[:, :2] / seen[:, 2:]
    left, top, right, bottom = pixels_of_hull(camera, corners)
    inside = ((pixels >= 0) & (pixels < [40, 30])).all(1)
    assert ((pixels >= [left, top]) & (pixels < [right, bottom])).all(1)[inside].all()


def test_a_hull_around_the_camera_takes_the_whole_image():
    camera = some_camera(1)
    assert pixels_of_hull(camera, box_corners(np.stack([camera.center] * 2), 0.1)) == (0, 0, 40, 30)


@pytest.mark.parametrize("region", [(0, 0, 8, 12), (3, 5, 16, 18), (2, 2, 3, 3), (5, 5, 5, 9), (5, 9, 5, 5)])
@pytest.mark.parametrize("most", [1, 40, 10_000])
def test_blocks_have_every_pixel_once(region, most):
    left, top, right, bottom = region
    parts = [np.stack(part, axis=1) for part in pixels_by_blocks(region, most)]
    assert all(len(part) <= max(most, 4 * (right - left + 3)) for part in parts)
    pixels = np.concatenate([*parts, np.empty((0, 2), int)])
    assert len(np.unique(pixels, axis=0)) == len(pixels)
    assert (np.ptp(pixels.reshape(-1, 16, 2), axis=1) == 3).all()
    inside = pixels[(pixels < [bottom, right]).all(1)]
    expected = {(row, column) for row in range(top, bottom) for column in range(left, right)}
    assert set(map(tuple, inside.tolist())) == expected
    assert (pixels < [bottom + 4, right + 4]).all()


STEP = 0.001


def along(density, values=None, *, start=0.5, length=0.4):
    """Composite one ray through a density given as a function of distance."""
    distances = start + STEP * (torch.arange(round(length / STEP), dtype=torch.float64) + 0.5)
    values = torch.ones(len(distances), 1, dtype=torch.float64) if values is None else values(distances)
    rays = torch.zeros(len(distances), dtype=torch.int64)
    return composite(density(distances) * STEP, values, distances, rays, torch.ones(1, dtype=torch.float64))


@pytest.mark.parametrize("density", [0.1, 5.0, 80.0])
def test_a_slab_of_constant_density_absorbs_by_beer_and_lambert(density):
    result = along(lambda t: torch.full_like(t, density))
    left = math.exp(-density * 0.4)
    assert result.transmittance.item() == pytest.approx(left, rel=1e-12)
    assert result.color.item() == pytest.approx(1 - left, rel=1e-12)
    # Mean of t under density exp(-density (t - 0.5)) on [0.5, 0.9].
    mean = 0.5 * (1 - left) + (1 - left) / density - 0.4 * left
    assert result.distance.item() == pytest.approx(mean, rel=2e-3)


def random_rays(seed=0, samples=60, rays=9):
    generator = torch.Generator().manual_seed(seed)
    owner = torch.randint(rays - 2, (samples,), generator=generator).sort().values + 1  # first and last: none
    thickness = torch.rand(samples, generator=generator, dtype=torch.float64)
    values = torch.rand(samples, 3, generator=generator, dtype=torch.float64)
    distances = torch.rand(samples, generator=generator, dtype=torch.float64)
    entering = torch.rand(rays, generator=generator, dtype=torch.float64) * 0.5 + 0.5
    return thickness, values, distances, owner, entering


def test_many_rays_at_once_are_each_ray_alone():
    thickness, values, distances, owner, entering = random_rays()
    together = composite(thickness, values, distances, owner, entering)
    for ray in range(len(entering)):
        light, color, distance = entering[ray].item(), np.zeros(3), 0.0
        for sample in (owner == ray).nonzero()[:, 0]:
            weight = light * (1 - math.exp(-thickness[sample]))
            color += weight * values[sample].numpy()
            distance += weight * distances[sample].item()
            light *= math.exp(-thickness[sample])
        np.testing.assert_allclose(together.color[ray], color, atol=1e-12)
        assert together.distance[ray].item() == pytest.approx(distance, abs=1e-12)
        assert together.transmittance[ray].item() == pytest.approx(light, abs=1e-12)


def test_gradients_pass_gradcheck():
    thickness, values, distances, owner, entering = random_rays(1, 14, 5)
    for tensor in (thickness, values, entering):
        tensor.requires_grad_()

    def summed(thickness, values, entering):
        return tuple(composite(thickness, values, distances, owner, entering))

    assert torch.autograd.gradcheck(summed, (thickness, values, entering))


def test_float32_keeps_its_digits_on_a_hundred_thousand_rays():
    # The optical depths of all rays are one running sum; that must not cost the last rays their digits.
    rays = 100_000
    thickness = torch.full((3 * rays,), 4.0)
    owner = torch.arange(rays).repeat_interleave(3)
    result = composite(thickness, torch.ones(3 * rays, 1), torch.ones(3 * rays), owner, torch.ones(rays))
    torch.testing.assert_close(result.transmittance, torch.full((rays,), math.exp(-12)), rtol=1e-5, atol=0)
    torch.testing.assert_close(result.color[:, 0], 1 - result.transmittance, rtol=1e-5, atol=0)
