"""The grid: what is occupied can be reached, what is empty is dropped, and nothing depends on how often one asks."""

import numpy as np
import torch

from headbench.methods.insta.field import Prior
from headbench.methods.insta.occupancy import occupied_space
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
