"""The sculpture is a human head in its measures, and a sound mesh."""

from __future__ import annotations

import numpy as np
import pymeshlab
import pytest

from headbench.bench.errors import InputError
from headbench.datasets.head.geometry import vertex_normals
from headbench.datasets.head.procedural.surface import MIRROR, eyeball, load_surface


def distance(head, a, b):
    return np.linalg.norm(head.template[head.landmarks[a]] - head.template[head.landmarks[b]])


# Adult ranges, metres: means of both sexes +- about 3 deviations (Farkas 1994).
@pytest.mark.parametrize(
    ("a", "b", "low", "high"),
    [
        ("vertex_top", "menton", 0.205, 0.255),
        ("left_mouth_corner", "right_mouth_corner", 0.043, 0.061),
        ("left_ala", "right_ala", 0.028, 0.043),
        ("left_eye_inner", "right_eye_inner", 0.026, 0.040),
        ("left_eye_inner", "left_eye_outer", 0.0255, 0.036),
        ("nose_bridge", "subnasale", 0.042, 0.062),
        ("subnasale", "menton", 0.055, 0.083),
    ],
)
def test_distances_are_human(head, a, b, low, high):
    assert low < distance(head, a, b) < high


def test_cranium_has_human_breadth_and_depth(head):
    scalp = head.template[head.regions["scalp"]]
    assert 0.135 < np.ptp(scalp[:, 0]) < 0.170
    assert 0.165 < head.template[head.landmarks["glabella"], 2] - scalp[:, 2].min() < 0.215


def test_eyes_lie_at_half_the_height_of_the_head(head):
    top, menton = (head.template[head.landmarks[name], 1] for name in ("vertex_top", "menton"))
    eye = head.template[head.regions["left_eyeball"], 1].mean()
    assert 0.44 < (eye - menton) / (top - menton) < 0.56


def test_features_stand_in_their_order_down_the_face(head):
    names = ("vertex_top", "forehead_mid", "glabella", "nose_bridge", "nose_tip", "subnasale")
    names += ("upper_lip_mid", "lower_lip_mid", "chin", "menton")
    heights = head.template[[head.landmarks[name] for name in names], 1]
    assert np.all(np.diff(heights) < 0)
    assert head.template[head.landmarks["nose_tip"], 2] == head.template[:, 2].max()


def test_skin_is_one_manifold_disk(surface):
    count = surface.skin_count
    faces = surface.faces[(surface.faces < count).all(axis=1)]
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(surface.vertices[:count], faces))
    found = meshes.get_topological_measures()
    assert found["is_mesh_two_manifold"]
    assert (found["genus"], found["number_holes"], found["connected_components_number"]) == (0, 1, 1)
    assert found["unreferenced_vertices"] == 0


def test_triangles_are_sound_and_wound_outward(surface):
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    edges = ((a - b) ** 2 + (b - c) ** 2 + (c - a) ** 2).sum(axis=1)
    quality = 4 * np.sqrt(3) * area / edges  # 1 for an equilateral triangle
    assert quality.min() > 0.03
    assert np.percentile(quality, 1) > 0.4
    assert np.median(quality) > 0.85
    for part in (*surface.eyeballs, np.arange(surface.skin_count)):
        inside = np.isin(surface.faces[:, 0], part)
        center = surface.vertices[part].mean(axis=0)
        volume = np.einsum("ij,ij->i", a - center, np.cross(b - center, c - center))[inside].sum() / 6
        assert volume > 0


def test_normals_point_out_of_the_forehead_and_the_back(surface, head):
    normals = vertex_normals(surface.vertices, surface.faces)
    assert normals[head.landmarks["forehead_mid"], 2] > 0.6
    assert normals[head.landmarks["vertex_top"], 1] > 0.9
    assert normals[np.argmin(surface.vertices[:, 2]), 2] < -0.9


def test_surface_is_its_own_mirror_image(surface):
    np.testing.assert_allclose(surface.vertices[surface.mirror], surface.vertices * MIRROR, atol=1e-7)
    np.testing.assert_array_equal(surface.mirror[surface.mirror], np.arange(len(surface.vertices)))
    mirrored = np.sort(surface.mirror[surface.faces], axis=1)
    assert set(map(tuple, mirrored)) == set(map(tuple, np.sort(surface.faces, axis=1)))


def test_eyeballs_are_spheres_that_the_skin_does_not_enter(surface):
    skin = surface.vertices[: surface.skin_count]
    for ball in surface.eyeballs:
        center = surface.vertices[ball].mean(axis=0)
        np.testing.assert_allclose(np.linalg.norm(surface.vertices[ball] - center, axis=1), 0.012, rtol=1e-6)
        gap = np.linalg.norm(skin - center, axis=1).min() - 0.012
        assert 0 < gap < 0.001  # the lids lie on the ball


def test_sphere_is_closed():
    vertices, faces = eyeball(6, 8)
    edges = len(
        np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1), axis=0)
    )
    assert len(vertices) - edges + len(faces) == 2


def test_another_file_is_refused(tmp_path):
    path = tmp_path / "other.npz"
    np.savez(path, vertices=np.zeros((4, 3)))
    with pytest.raises(InputError, match=r"other\.npz"):
        load_surface(path)
