"""What stands in for PyTorch3D's meshes: against brute force in float64 and the native method's texels."""

import numpy as np
import pytest
import torch

from headbench.methods.official.shim.meshes import SMALLEST_AREA, Mesh, load_obj, rasterize_meshes
from headbench.methods.shared.surface_points import texel_points

SIZE = 24


def mesh(vertices, faces):
    return Mesh(torch.tensor(vertices)[None].float(), torch.tensor(faces)[None])


def brute_force(vertices, faces, size):
    """Triangle, z and barycentric coordinates by pixel: every triangle in every pixel, by solving for the weights."""
    found = {}
    for row in range(size):
        for column in range(size):
            # To the right and downwards, normalised device coordinates go from 1 to -1.
            point = [1 - (2 * column + 1) / size, 1 - (2 * row + 1) / size]
            hits = []
            for index, corners in enumerate(vertices[faces]):
                system = np.vstack([corners[:, :2].T, np.ones(3)])
                if abs(np.linalg.det(system)) <= SMALLEST_AREA:
                    continue
                weights = np.linalg.solve(system, [*point, 1.0])
                depth = float(weights @ corners[:, 2])
                if weights.min() > 0 and depth >= 0:
                    hits.append((depth, index, weights))
            if hits:
                found[row, column] = min(hits, key=lambda hit: hit[:2])
    return found


def test_pixels_have_the_triangle_of_brute_force():
    random = np.random.default_rng(0)
    vertices = random.uniform(-1.2, 1.2, (30, 3)).astype(np.float32).astype(np.float64)
    vertices[:, 2] += 0.9  # some are behind z = 0
    faces = random.integers(0, 30, (25, 3))
    faces[3] = faces[7]  # the first of equal depth
    faces[4, 1] = faces[4, 0]  # no area
    triangles, z, barycentric, _ = rasterize_meshes(mesh(vertices, faces), image_size=SIZE)
    assert triangles.shape == z.shape == (1, SIZE, SIZE, 1)
    expected = brute_force(vertices, faces, SIZE)
    assert 100 < len(expected) < SIZE**2
    for row in range(SIZE):
        for column in range(SIZE):
            hit = expected.get((row, column))
            assert int(triangles[0, row, column, 0]) == (-1 if hit is None else hit[1])
            if hit is not None:
                assert float(z[0, row, column, 0]) == pytest.approx(hit[0], abs=1e-6)
                assert barycentric[0, row, column, 0].numpy() == pytest.approx(hit[2], abs=1e-6)


def test_the_upper_left_is_the_first_row_and_column():
    triangle = [[0.99, 0.99, 1.0], [0.4, 0.99, 1.0], [0.99, 0.4, 1.0]]
    triangles = rasterize_meshes(mesh(triangle, [[0, 1, 2]]), image_size=4)[0][0, :, :, 0]
    assert (triangles == 0).nonzero().tolist() == [[0, 0]]
    turned = rasterize_meshes(mesh(triangle, [[2, 1, 0]]), image_size=4)[0][0, :, :, 0]
    assert torch.equal(triangles, turned)


def test_texels_of_a_chart_are_those_of_the_native_method():
    """A grid of cells, each of two triangles, a third of which have no place in the chart."""
    random, side = np.random.default_rng(1), 7
    lines = np.linspace(0.03, 0.96, side + 1)
    places = np.stack(np.meshgrid(lines, lines), axis=-1) + random.uniform(
        -0.03, 0.03, (side + 1, side + 1, 2)
    )
    corner = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
    a, b, c, d = (corner[i : i + side, j : j + side].ravel() for i in (0, 1) for j in (0, 1))
    faces = np.concatenate([np.column_stack([a, b, d]), np.column_stack([a, d, c])])
    uv = places.reshape(-1, 2)[faces].astype(np.float32).astype(np.float64)
    kept = np.flatnonzero(random.random(len(faces)) > 1 / 3)
    edges = uv[kept, 1:] - uv[kept, :1]
    area = 0.5 * np.abs(np.linalg.det(edges)).sum()
    resolution = 40
    points = texel_points(uv, kept, round(area * resolution**2))

    # As the authors' code calls it: coordinates run from -1 to 1, and both axes are turned.
    ndc = 1 - 2 * uv[kept].reshape(-1, 2)
    ndc[:, 1] *= -1
    vertices = np.column_stack([ndc, np.ones(len(ndc))])
    corners = np.arange(3 * len(kept)).reshape(-1, 3)
    triangles, _, barycentric, _ = rasterize_meshes(mesh(vertices, corners), image_size=resolution)
    hit = triangles[0, :, :, 0].numpy()
    rows, columns = np.nonzero(hit >= 0)
    assert len(rows) == len(points.triangles) > 300
    theirs = {
        (row, column): (kept[hit[row, column]], barycentric[0, row, column, 0].numpy())
        for row, column in zip(rows, columns)
    }
    at = (points.barycentric[:, :, None] * uv[points.triangles]).sum(1) * resolution
    for triangle, weights, (x, y) in zip(*points, at):
        found, theirs_weights = theirs[resolution - 1 - int(y), int(x)]
        assert found == triangle
        assert theirs_weights == pytest.approx(weights, abs=2e-4)  # vertices are float32


def test_objects_with_and_without_a_chart_are_read(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text(
        "# a\no head\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0.5 0.25\nvt 1 0\nvn 0 0 1\nf 1/2/1 2/1/1 3/1/1\nf 3 2 1\nf 1//1 2//1 3//1\n"
    )
    vertices, faces, extra = load_obj(str(path), load_textures=False)
    assert vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert faces.verts_idx.tolist() == [[0, 1, 2], [2, 1, 0], [0, 1, 2]]
    assert faces.textures_idx.tolist() == [[1, 0, 0], [-1] * 3, [-1] * 3]
    assert extra.verts_uvs.tolist() == [[0.5, 0.25], [1, 0]]
    path.write_text("v 0 0 0\nf 1 1 1\n")
    assert load_obj(str(path))[2].verts_uvs is None
