"""The grid: what is occupied can be reached, what is empty is dropped, and nothing depends on how often one asks."""

import numpy as np
import pytest
import torch

from headbench.methods.insta.config import InstaConfig
from headbench.methods.insta.field import Architecture, Field, Prior
from headbench.methods.insta.marching import canonical_surface
from headbench.methods.insta.occupancy import Occupancy, occupied_space
from headbench.methods.insta.warp import mouth_triangles
from headbench.methods.shared.subject_mesh import SubjectMesh

from .small import SMALL


@pytest.fixture(scope="module")
def surface(head):
    mesh = SubjectMesh(head, np.zeros(head.shape_basis.shape[2]), np.zeros_like(head.template), "cpu")
    return canonical_surface(head, mesh, InstaConfig(**SMALL))


def test_occupied_cells_are_within_their_triangles_reach(surface):
    occupancy = Occupancy(surface, InstaConfig(**SMALL))
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


def test_candidates_are_the_shell_around_the_mesh(surface):
    config = InstaConfig(**SMALL)
    occupancy = Occupancy(surface, config)
    rng = np.random.default_rng(1)
    size = occupancy.size
    points = (occupancy.low + occupancy.cell * size * rng.random((3000, 3))).astype(np.float32)
    distances = surface.rest.nearest(points).values.sqrt().numpy()
    cells = np.floor((points - occupancy.low) / occupancy.cell).astype(int).clip(0, size - 1)
    inside = np.isin(np.ravel_multi_index(cells.T, size), occupancy.candidates)
    assert inside[distances < config.shell_inside].all()
    assert not inside[distances > config.shell_outside + 2 * occupancy.cell].any()


def refreshed(head, surface, prior, rounds=1, whole=True):
    config = InstaConfig(**SMALL)
    occupancy = Occupancy(surface, config)
    field = Field(Architecture.of(config, 8), occupancy.box("cpu"), prior)
    parameters = field.architecture.initial(0)
    for iteration in range(rounds):
        occupancy.refresh(field, parameters, torch.zeros(8), mouth_triangles(head), 5, iteration, whole=whole)
    return occupancy


def test_empty_and_dense_fields_occupy_nothing_and_everything(head, surface):
    empty = refreshed(head, surface, Prior(-200, 0, 1))
    assert not empty.occupied.any()
    assert (empty.space().reach < 0).all()
    assert refreshed(head, surface, Prior(5, 0, 1)).occupied.all()


def test_a_field_that_hugs_the_mesh_leaves_a_thin_shell(head, surface):
    thin = refreshed(head, surface, Prior(6, 50, 0.001))
    distances = thin._distances[thin.occupied]
    assert 0.05 < thin.occupied.mean() < 0.7
    assert distances.max() < 0.012


def test_values_decay_where_the_field_empties(head, surface):
    config = InstaConfig(**SMALL)
    occupancy = refreshed(head, surface, Prior(5, 0, 1))
    before = occupancy.values.copy()
    field = Field(Architecture.of(config, 8), occupancy.box("cpu"), Prior(-200, 0, 1))
    occupancy.refresh(
        field, field.architecture.initial(0), torch.zeros(8), mouth_triangles(head), 5, 1, whole=True
    )
    np.testing.assert_allclose(occupancy.values, config.occupancy_decay * before, rtol=1e-6)


def test_partial_refreshes_reach_every_cell(head, surface):
    one, other = (refreshed(head, surface, Prior(3, 0, 1), rounds=40, whole=False) for _ in range(2))
    assert np.isfinite(one.values).mean() > 0.99
    np.testing.assert_array_equal(one.values, other.values)
