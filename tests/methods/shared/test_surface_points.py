"""Points on a surface: where they are, how far apart."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull, cKDTree
from scipy.spatial.transform import Rotation

from headbench.bench.errors import InputError
from headbench.datasets.head.geometry import triangle_areas
from headbench.datasets.head.model import HeadModel
from headbench.methods.shared.avatar_files import clip_mesh
from headbench.methods.shared.surface_points import (
    RADIUS,
    BoundedCache,
    SubjectMesh,
    mouth_mask,
    poisson_disk,
    spacing,
    spread_points,
    texel_points,
)
from headbench.methods.shared.surface_splats import HeadSurface

from ...datasets.head.toy import toy_head
from ..toy_clip import first_view, look_at


def test_axes_follow_the_neck_where_the_surface_does(clip):
    mesh = clip_mesh(clip, "cpu")
    faces, vertices = clip.head.faces, mesh.canonical.numpy()
    surface = HeadSurface(mesh, poisson_disk(vertices, faces, np.arange(len(faces)), 400, 0))
    pose = replace(clip.poses[0], rotation=np.array([0.1, 0.4, 0.0]), neck=np.array([0.5, 0.0, -0.2]))
    found = Rotation.from_matrix(surface.posed(mesh.arguments([pose])).rotation.numpy())
    share = surface._of_root[:, 0].numpy()
    root, neck = Rotation.from_rotvec(pose.rotation), Rotation.from_rotvec(pose.neck)
    for end, part in ((root, 1 - share), (root * neck, share)):
        np.testing.assert_allclose((end.inv() * found).magnitude(), part * neck.magnitude(), atol=0.005)
    assert share.max() > 0.5
    assert share.min() == 0


def test_a_neck_beyond_half_a_turn_has_axes_of_the_shorter_turn(clip):
    mesh = clip_mesh(clip, "cpu")
    faces, vertices = clip.head.faces, mesh.canonical.numpy()
    surface = HeadSurface(mesh, poisson_disk(vertices, faces, np.arange(len(faces)), 400, 0))
    neck = np.array([0.5, 0.0, -0.2])
    longer = neck * (1 - 2 * np.pi / np.linalg.norm(neck))
    found, expected = (
        surface.posed(mesh.arguments([replace(clip.poses[0], neck=each)])).rotation for each in (longer, neck)
    )
    np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.parametrize("eyelids", [False, True])
def test_posed_vertices_and_gradients_are_the_head_models(clip, head, eyelids):
    rng = np.random.default_rng(0)
    offset = rng.normal(scale=0.001, size=head.template.shape)
    lids = rng.normal(scale=0.01, size=(*offset.shape, 2)) if eyelids else None
    head = replace(head, eyelid_basis=lids)
    mesh, model = SubjectMesh(head, clip.shape, offset, "cpu"), HeadModel(head, dtype=torch.float64)
    pose = replace(clip.poses[1], neck=np.array([0.3, -0.2, 0.1]), eyelids=np.array([0.5, 0.2]))
    canonical = model.canonical(torch.from_numpy(clip.shape), torch.from_numpy(offset))
    weights = torch.from_numpy(rng.normal(size=offset.shape))
    found, expected = mesh.arguments([pose]), model.pose_arguments([pose])
    driven = mesh.drive(pose).center
    np.testing.assert_allclose(
        driven, model(canonical=canonical, **expected)[0][mesh.faces].mean(1), atol=1e-6
    )
    for arguments, vertices in (
        (found, lambda: mesh.posed(found)),
        (expected, lambda: model(canonical=canonical, **expected)[0]),
    ):
        for value in arguments.values():
            value.requires_grad_()
        posed = vertices()
        posed.backward(weights.to(posed.dtype))
        arguments["vertices"] = posed.detach()
    np.testing.assert_allclose(found.pop("vertices"), expected.pop("vertices"), atol=1e-6)
    assert ("eyelids" in found) == eyelids
    for name, value in expected.items():
        scale = float(value.grad.abs().max())
        np.testing.assert_allclose(found[name].grad, value.grad, atol=1e-5 * scale, rtol=0, err_msg=name)


def test_unposed_drops_rotation_neck_and_translation_only(clip, head):
    mesh = SubjectMesh(head, clip.shape, clip.static_offset, "cpu")
    arguments = mesh.arguments([clip.poses[0]])
    found = mesh.unposed(arguments)
    for name in ("rotation", "neck", "translation"):
        changed = {**arguments, name: arguments[name] + 0.3}
        np.testing.assert_array_equal(mesh.unposed(changed), found)
    for name in ("expression", "jaw", "eyes"):
        changed = {**arguments, name: arguments[name] + 0.3}
        assert (mesh.unposed(changed) - found).abs().max() > 1e-5


def test_a_neutral_pose_is_canonical(clip, head):
    mesh = SubjectMesh(head, clip.shape, clip.static_offset, "cpu")
    neutral = {name: torch.zeros_like(v) for name, v in mesh.arguments([clip.poses[0]]).items()}
    np.testing.assert_allclose(mesh.posed(neutral), mesh.canonical, atol=1e-7)


def test_the_mask_is_the_outline_of_the_lips(clip):
    camera, pose = first_view(clip)
    camera, mesh = camera.resized(280, 360), clip_mesh(clip, "cpu")
    vertices = mesh.posed(mesh.arguments([pose])).numpy()
    lips, middle = vertices[clip.head.regions["lips"]], vertices.mean(0)
    mask = mouth_mask(camera, lips, middle)
    projected = (camera.K @ (camera.world_to_camera @ np.c_[lips, np.ones(len(lips))].T)[:3]).T
    hull = ConvexHull(projected[:, :2] / projected[:, 2:]).equations
    pixels = np.stack(np.meshgrid(np.arange(280) + 0.5, np.arange(360) + 0.5), axis=-1)
    outside = (pixels @ hull[:, :2].T + hull[:, 2]).max(-1)
    assert mask[outside < -1].all()
    assert not mask[outside > 1].any()
    assert (outside < -1).sum() > 200
    behind = look_at(np.array([0.0, 0.0, -0.5]), np.zeros(3), "behind", 280, 360)
    assert not mouth_mask(behind, lips, middle).any()


def test_the_cache_computes_once_and_stays_bounded():
    computed = []

    def square(key):
        computed.append(key)
        return key * key

    cache = BoundedCache(square, 2)
    assert [cache(k) for k in (1, 2, 1, 3, 1, 2)] == [1, 4, 1, 9, 1, 4]
    assert computed == [1, 2, 3, 2]  # 2 was the least recently used when 3 came
    assert len(cache) == 2


def test_an_identity_that_makes_no_head_is_refused(clip, head):
    with pytest.raises(InputError, match="a head within 10 m"):
        SubjectMesh(head, np.full_like(clip.shape, 9e3), clip.static_offset, "cpu")


COUNT = 1500


@pytest.fixture(scope="module")
def ball():
    """Vertices and outward triangles of a sphere of 0.1 m."""
    index = np.arange(600) + 0.5
    polar, around = np.arccos(1 - 2 * index / 600), np.pi * (1 + 5**0.5) * index
    flat = np.stack([np.cos(around), np.sin(around)], axis=1) * np.sin(polar)[:, None]
    points = 0.1 * np.column_stack([flat, np.cos(polar)])
    return points, ConvexHull(points).simplices.astype(np.int64)


def test_samples_are_blue_noise_on_the_triangles_asked_for(ball):
    vertices, faces = ball
    upper = np.flatnonzero((vertices[faces][:, :, 2] > 0).all(1))
    found = poisson_disk(vertices, faces, upper, COUNT, 0)
    assert set(found.triangles) <= set(upper)
    assert len(found.triangles) == pytest.approx(COUNT, rel=0.05)
    assert found.barycentric.min() >= -1e-7
    np.testing.assert_allclose(found.barycentric.sum(1), 1, atol=1e-12)
    positions = found.positions(vertices, faces)
    area = triangle_areas(vertices, faces[upper]).sum()
    nearest = cKDTree(positions).query(positions, k=2)[0][:, 1]
    assert nearest.min() >= RADIUS * np.sqrt(area / COUNT) * 0.999
    # No hole: every point of the surface has a sample nearby; as candidates are few, a little beyond the disk's radius.
    corners = vertices[faces[upper]]
    assert cKDTree(positions).query(corners.mean(1))[0].max() <= 1.3 * RADIUS * np.sqrt(area / COUNT)


def test_spacing_is_the_root_mean_square_of_three_neighbours():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [9, 9, 9]], float)
    assert spacing(points)[0] == pytest.approx(np.sqrt((1 + 4 + 9) / 3))
    assert spacing(np.zeros((4, 3)))[0] == pytest.approx(np.sqrt(1e-7))
    assert spacing(np.zeros((1, 3)))[0] == pytest.approx(np.sqrt(1e-7))


def square_chart(n):
    """A square of n x n cells in two triangles each, whose chart is the unit square, wound both ways."""
    grid = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, n + 1)], indexing="ij"), axis=-1).reshape(-1, 2)
    index = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    corners = (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])
    one, two, three, four = (corner.ravel() for corner in corners)
    faces = np.concatenate([np.stack([one, two, three], 1), np.stack([one, four, three], 1)])
    return grid, faces


@pytest.mark.parametrize("n", [1, 7])
@pytest.mark.parametrize("size", [16, 33])
def test_each_texel_of_a_chart_has_one_point(n, size):
    grid, faces = square_chart(n)
    found = texel_points(grid[faces], np.arange(len(faces)), size**2)
    texels = size * found.positions(grid, faces) - 0.5
    np.testing.assert_allclose(texels, texels.round(), atol=1e-4)
    assert len(np.unique(texels.round(), axis=0)) == len(texels) == size**2
    np.testing.assert_allclose(found.barycentric.sum(1), 1, atol=1e-12)
    assert found.barycentric.min() >= -1e-6


@pytest.mark.parametrize("count", [4_000, 16_000, 64_000])
def test_number_of_texels_is_area_times_squared_resolution(ball, count):
    vertices, faces = ball
    # Each half is nearly a disk of radius 0.3.
    flat = 0.5 + 0.3 * vertices[:, :2] / np.linalg.norm(vertices, axis=1, keepdims=True)
    lower = (vertices[faces][:, :, 2] > 0).all(1)
    area = triangle_areas(np.pad(flat, ((0, 0), (0, 1))), faces[lower]).sum()
    assert area == pytest.approx(np.pi * 0.3**2, rel=0.1)
    found = texel_points(flat[faces], np.flatnonzero(lower), count)
    resolution = round((count / area) ** 0.5)
    assert len(found.triangles) == pytest.approx(area * resolution**2, rel=0.02)
    assert len(found.triangles) == pytest.approx(count, rel=0.02)
    assert set(found.triangles) <= set(np.flatnonzero(lower))
    uv = (found.barycentric[:, :, None] * flat[faces[found.triangles]]).sum(1)
    np.testing.assert_allclose(resolution * uv % 1, 0.5, atol=1e-4)


def test_triangles_without_a_place_in_the_chart_have_no_point():
    grid, faces = square_chart(2)
    uv = grid[faces]
    uv[3] = 0
    found = texel_points(uv, np.arange(len(faces)), 400)
    assert set(found.triangles) == set(range(len(faces))) - {3}
    for nowhere in (np.zeros_like(uv), uv[:, [0, 0, 1]]):
        with pytest.raises(InputError, match="cover a part of the square"):
            texel_points(nowhere, np.arange(len(faces)), 400)


def test_a_head_without_a_chart_has_blue_noise():
    head = toy_head()
    vertices, everything = head.template, np.arange(len(head.faces))
    noise = poisson_disk(vertices, head.faces, everything, 500, 3)
    charted = replace(head, uv=np.random.default_rng(0).random((len(head.faces), 3, 2)))
    for points in (
        spread_points(head, vertices, 500, 3),
        spread_points(charted, vertices, 500, 3, chart=False),
    ):
        np.testing.assert_array_equal(points.triangles, noise.triangles)
        np.testing.assert_array_equal(points.barycentric, noise.barycentric)
    border = np.arange(40)
    found = spread_points(charted, vertices, 500, 3, chart_without=border)
    assert len(found.triangles)
    assert not np.isin(head.faces[found.triangles], border).any()
