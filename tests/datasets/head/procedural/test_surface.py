"""The sculpture is a human head in its measures, and a sound mesh."""

import numpy as np
import pymeshlab
import pytest

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
