"""The sculpture is a human head in its measures, and a sound mesh."""

import numpy as np
import pymeshlab
import pytest

from headbench.datasets.head.geometry import triangle_areas
from headbench.datasets.head.procedural.surface import JOINTS, MIRROR

from ..skinning import skinned

# Adult ranges, metres: means of both sexes +- about 3 deviations (Farkas 1994).
MEASURES = [
    *(("vertex_top", "menton", 0.205, 0.255), ("left_mouth_corner", "right_mouth_corner", 0.043, 0.061)),
    *(("left_ala", "right_ala", 0.028, 0.043), ("left_eye_inner", "right_eye_inner", 0.026, 0.040)),
    *(("nose_bridge", "subnasale", 0.042, 0.062), ("subnasale", "menton", 0.055, 0.083)),
    ("left_eye_inner", "left_eye_outer", 0.0255, 0.036),
]


def test_features_have_human_distances_and_stand_in_order(head):
    place = {name: head.template[vertex] for name, vertex in head.landmarks.items()}
    for a, b, low, high in MEASURES:
        assert low < np.linalg.norm(place[a] - place[b]) < high, (a, b)
    names = ("vertex_top", "forehead_mid", "glabella", "nose_bridge", "nose_tip", "subnasale")
    names += ("upper_lip_mid", "lower_lip_mid", "chin", "menton")
    assert np.all(np.diff([place[name][1] for name in names]) < 0)
    assert place["nose_tip"][2] == head.template[:, 2].max()


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
    area = triangle_areas(surface.vertices, surface.faces)
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


OPEN = (0.30, 0.0, 0.0)


def test_regressor_finds_the_designed_joints(head):
    assert head.joint_regressor.sum(axis=1) == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose(head.joint_regressor @ head.template, JOINTS, atol=1e-6)


def test_regressed_eyes_stay_in_their_balls_for_any_identity(head):
    shape = np.random.default_rng(3).normal(size=head.shape_basis.shape[2])
    vertices = head.template + head.shape_basis @ shape
    joints = head.joint_regressor @ vertices
    for joint, name in ((3, "left_eyeball"), (4, "right_eyeball")):
        ball = vertices[head.regions[name]]
        radii = np.linalg.norm(ball - joints[joint], axis=1)
        np.testing.assert_allclose(radii, 0.012, atol=2e-4)


def test_weights_are_shares(head):
    assert head.skinning_weights.min() >= 0
    np.testing.assert_allclose(head.skinning_weights.sum(axis=1), 1, atol=1e-6)
    assert np.all(head.skinning_weights[head.regions["left_eyeball"], 3] == 1)
    assert np.all(head.skinning_weights[head.regions["right_eyeball"], 4] == 1)
    assert head.skinning_weights[head.landmarks["chin"], 2] == 1
    assert head.skinning_weights[head.landmarks["upper_lip_mid"], 2] == 0


def test_weights_change_gradually_except_between_the_lips(head, surface):
    edges = np.unique(np.sort(surface.faces[:, :2], axis=1), axis=0)
    skin = (edges < surface.skin_count).all(axis=1) & (np.abs(surface.vertices[edges[:, 0], 0]) > 0.030)
    jaw = head.skinning_weights[:, 2]
    assert np.abs(jaw[edges[skin, 0]] - jaw[edges[skin, 1]]).max() < 0.45


def test_opening_the_jaw_parts_the_lips_by_the_arc_of_the_jaw(head):
    vertices = skinned(head, jaw=OPEN)
    upper, lower = (head.regions[f"lip_outside_ring_{part}"][7] for part in ("upper", "lower"))
    arm = np.linalg.norm(head.template[lower, 1:] - JOINTS[2, 1:])
    moved = np.linalg.norm(vertices[lower] - head.template[lower])
    assert moved == pytest.approx(2 * arm * np.sin(OPEN[0] / 2), rel=0.05)
    assert vertices[upper, 1] - vertices[lower, 1] > 0.020
    np.testing.assert_allclose(
        vertices[head.regions["scalp"]], head.template[head.regions["scalp"]], atol=1e-6
    )


def test_regions_contain_what_their_names_say(head):
    regions = {name: set(members.tolist()) for name, members in head.regions.items()}
    assert regions["eye_region"] <= regions["face"]
    assert regions["forehead"] <= regions["face"]
    assert regions["left_eye_region"] | regions["right_eye_region"] <= regions["eye_region"]
    assert len(regions["nose"] & regions["face"]) > 0.7 * len(regions["nose"])
    assert len(regions["lips"] & regions["face"]) > 0.7 * len(regions["lips"])
    for name in ("left_ear", "right_ear", "left_eyeball", "right_eyeball", "neck"):
        assert not regions["face"] & regions[name]
    assert not regions["scalp"] & regions["neck"]
    assert regions["boundary"] <= regions["neck"]
    known = set().union(*regions.values())
    assert known == set(range(len(head.template)))


def test_rings_run_along_the_lips(head):
    upper, lower = (head.regions[f"lip_outside_ring_{part}"] for part in ("upper", "lower"))
    assert len(upper) == len(lower) == 15
    for ring in (upper, lower):
        assert np.all(np.diff(head.template[ring, 0]) > 0)
    assert np.all(head.template[upper, 1] > head.template[lower, 1])
    assert 0.003 < np.linalg.norm(head.template[upper] - head.template[lower], axis=1).mean() < 0.008
