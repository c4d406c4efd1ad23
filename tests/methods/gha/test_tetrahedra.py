"""The grid fills its box, and the surface in it is the one that the distances describe."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import dblquad

from headbench.methods.gha.tetrahedra import TetGrid, marching_tetrahedra, spacing_for, tet_grid


def box(half=1.3, spacing=0.1):
    return tet_grid(np.full(3, -half), np.full(3, half), spacing)


def surface(grid: TetGrid, distance: torch.Tensor):
    crossings = marching_tetrahedra(distance, grid.tets)
    return crossings.interpolate(grid.vertices.to(distance.dtype)), crossings.faces


def area_and_volume(vertices, faces):
    corners = vertices.double()[faces]
    across = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return across.norm(dim=1).sum().item() / 2, (corners[:, 0] * across).sum().item() / 6


def ellipsoid_area(a, b, c):
    """Integral of |dx/du x dx/dv| over the unit sphere's angles."""

    def density(v, u):
        s, k = np.sin(u), np.cos(u)
        across = np.array([b * c * s * s * np.cos(v), a * c * s * s * np.sin(v), a * b * s * k])
        return np.linalg.norm(across)

    return dblquad(density, 0, np.pi, 0, 2 * np.pi, epsabs=1e-4)[0]


def test_the_tetrahedra_fill_the_box_without_overlap():
    grid = tet_grid(np.zeros(3), np.array([0.5, 0.7, 0.3]), 0.1)
    corners = grid.vertices.double()[grid.tets]
    volumes = torch.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    assert volumes.min() > 0
    assert volumes.sum().item() == pytest.approx(0.5 * 0.7 * 0.3, rel=1e-6)
    # Within the box each triangle belongs to two tetrahedra, on its sides to one: no gaps, nothing twice.
    triangles = torch.cat([grid.tets[:, [i for i in range(4) if i != k]] for k in range(4)]).sort(1).values
    places, counts = torch.unique(triangles, dim=0, return_counts=True)
    assert set(counts.tolist()) == {1, 2}
    single = grid.vertices[places[counts == 1]]
    high = torch.tensor([0.5, 0.7, 0.3])
    on_side = ((single == 0) | ((single - high).abs() < 1e-6)).all(1).any(1)
    assert on_side.all()


def test_spacing_gives_about_the_number_asked_for():
    low, high = np.array([-1.0, -2.0, -1.5]), np.array([1.0, 1.8, 1.2])
    grid = tet_grid(low, high, spacing_for(low, high, 20_000))
    assert len(grid.vertices) == pytest.approx(20_000, rel=0.15)


def test_a_sphere_has_its_area_and_volume_within_a_hundredth():
    grid = box()
    area, volume = area_and_volume(*surface(grid, grid.vertices.norm(dim=1) - 1))
    assert area == pytest.approx(4 * np.pi, rel=0.01)
    assert volume == pytest.approx(4 / 3 * np.pi, rel=0.01)


@settings(max_examples=4, deadline=None)
@given(st.tuples(*[st.floats(0.5, 1.2)] * 3), st.tuples(*[st.floats(-0.05, 0.05)] * 3))
def test_ellipsoids_have_their_area_and_volume(axes, center):
    grid = box(spacing=0.08)
    scaled = (grid.vertices.double() - torch.tensor(center)) / torch.tensor(axes)
    area, volume = area_and_volume(*surface(grid, scaled.norm(dim=1) - 1))
    assert volume == pytest.approx(4 / 3 * np.pi * np.prod(axes), rel=0.015)
    assert area == pytest.approx(ellipsoid_area(*axes), rel=0.015)


def test_a_closed_surface_is_watertight_and_turned_outwards():
    grid = box()
    generator = torch.Generator().manual_seed(0)
    rough = grid.vertices.norm(dim=1) - 0.9 + 0.1 * torch.randn(len(grid.vertices), generator=generator)
    rough[(grid.vertices.abs() > 1.25).any(1)] = 1
    vertices, faces = surface(grid, rough)
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward = set(map(tuple, edges.tolist()))
    assert len(forward) == len(edges)  # no directed edge twice
    assert forward == {(b, a) for a, b in forward}  # each has its opposite
    assert area_and_volume(vertices, faces)[1] > 0
    assert torch.equal(faces.unique(), torch.arange(len(vertices)))


@given(st.tuples(*[st.floats(-1, 1)] * 3), st.floats(-0.5, 0.5))
@settings(max_examples=20, deadline=None)
def test_a_plane_is_exact(normal, shift):
    direction = torch.tensor(normal, dtype=torch.float64)
    if direction.norm() < 0.1:
        return
    direction = direction / direction.norm()
    grid = box(1.0, 0.25)
    vertices, _ = surface(grid, grid.vertices.double() @ direction - shift)
    assert (vertices @ direction - shift).abs().max() < 1e-9


def test_values_are_interpolated_along_with_the_surface():
    grid = box()
    crossings = marching_tetrahedra(grid.vertices.norm(dim=1) - 1, grid.tets)
    linear = grid.vertices @ torch.tensor([[1.0, 2.0], [0.5, -1.0], [3.0, 0.0]]) + 0.25
    expected = (
        crossings.interpolate(grid.vertices) @ torch.tensor([[1.0, 2.0], [0.5, -1.0], [3.0, 0.0]]) + 0.25
    )
    assert torch.allclose(crossings.interpolate(linear), expected, atol=1e-5)


def test_gradients_by_the_distances_agree_with_finite_differences():
    grid = tet_grid(np.full(3, -1.0), np.full(3, 1.0), 0.5)
    places = grid.vertices.double()
    distance = (places * torch.tensor([1.0, 1.1, 0.9])).norm(dim=1) - 0.71

    def vertices(values):
        return marching_tetrahedra(values, grid.tets).interpolate(places)

    assert torch.autograd.gradcheck(vertices, distance.requires_grad_(), eps=1e-6)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_nothing_where_nothing_changes_sign(sign):
    grid = box(1.0, 0.5)
    crossings = marching_tetrahedra(torch.full((len(grid.vertices),), sign), grid.tets)
    assert crossings.faces.shape == (0, 3)
    assert crossings.interpolate(grid.vertices).shape == (0, 3)
