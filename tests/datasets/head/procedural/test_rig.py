"""Joints, weights, correctives, regions and landmarks of the default head."""

from __future__ import annotations

import numpy as np
import pytest

from headbench.datasets.head.geometry import smoothstep
from headbench.datasets.head.procedural.surface import JOINTS

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


def test_weights_change_gradually_but_for_the_cut_between_the_lips(head, surface):
    edges = np.unique(np.sort(surface.faces[:, :2], axis=1), axis=0)
    skin = (edges < surface.skin_count).all(axis=1) & (np.abs(surface.vertices[edges[:, 0], 0]) > 0.030)
    jaw = head.skinning_weights[:, 2]
    assert np.abs(jaw[edges[skin, 0]] - jaw[edges[skin, 1]]).max() < 0.45


def test_opening_the_jaw_parts_the_lips_by_the_arc_of_the_jaw(head, pose):
    vertices = pose(head, jaw=OPEN)
    upper, lower = (head.regions[f"lip_outside_ring_{part}"][7] for part in ("upper", "lower"))
    arm = np.linalg.norm(head.template[lower, 1:] - JOINTS[2, 1:])
    moved = np.linalg.norm(vertices[lower] - head.template[lower])
    assert moved == pytest.approx(2 * arm * np.sin(OPEN[0] / 2), rel=0.05)
    assert vertices[upper, 1] - vertices[lower, 1] > 0.020
    np.testing.assert_allclose(
        vertices[head.regions["scalp"]], head.template[head.regions["scalp"]], atol=1e-6
    )


def test_jaw_corrective_is_small_and_symmetric(head, surface):
    basis = head.pose_basis
    assert 0 < np.abs(basis).max() < 0.02
    assert not basis[:, :, :9].any()
    assert not basis[:, :, 18:].any()
    np.testing.assert_allclose(basis[surface.mirror], basis * np.array([-1, 1, 1])[:, None], atol=1e-6)


def test_regions_hold_what_their_names_say(head):
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


def test_regions_of_a_side_mirror_each_other(head, surface):
    for name in ("ear", "eye_region", "eyeball"):
        left, right = head.regions[f"left_{name}"], head.regions[f"right_{name}"]
        np.testing.assert_array_equal(np.sort(surface.mirror[left]), right)
        assert head.template[left, 0].min() > 0


def test_rings_run_along_the_lips(head):
    upper, lower = (head.regions[f"lip_outside_ring_{part}"] for part in ("upper", "lower"))
    assert len(upper) == len(lower) == 15
    assert np.all(np.diff(head.template[upper, 0]) > 0)
    assert np.all(np.diff(head.template[lower, 0]) > 0)
    assert np.all(head.template[upper, 1] > head.template[lower, 1])
    assert 0.003 < np.linalg.norm(head.template[upper] - head.template[lower], axis=1).mean() < 0.008


def test_landmarks_lie_in_their_regions(head):
    for landmark, region in {
        "nose_tip": "nose",
        "upper_lip_mid": "face",
        "left_eye_inner": "left_eye_region",
        "right_eye_outer": "right_eye_region",
        "left_ear": "face",
        "vertex_top": "scalp",
        "forehead_mid": "forehead",
    }.items():
        if landmark == "left_ear":
            near = head.template[head.regions["left_ear"]] - head.template[head.landmarks[landmark]]
            assert np.linalg.norm(near, axis=1).min() < 0.006
        else:
            assert head.landmarks[landmark] in head.regions[region]


def test_smoothstep_is_the_cubic_between_its_ends():
    np.testing.assert_allclose(smoothstep(np.array([-1, 0, 0.5, 1, 2]), 0, 1), [0, 0, 0.5, 1, 1])
    assert smoothstep(np.array([0.25]), 0, 1)[0] == pytest.approx(3 * 0.25**2 - 2 * 0.25**3)
