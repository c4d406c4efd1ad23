"""GNM Head: the translated head against GNM's definition, on files of its layout."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.contracts import HeadPose
from headbench.bench.errors import InputError
from headbench.datasets.benchmarks.refit import performance
from headbench.datasets.head.gnm import gnm_head, is_gnm
from headbench.datasets.head.loaders import load_head
from headbench.datasets.head.procedural.model import procedural_head
from headbench.datasets.head.refit.refit import refit

from .gnm_files import gnm_content, gnm_vertices, write_gnm
from .toy import toy_head


def random_pose(head, rng):
    turn = lambda size: rng.normal(scale=0.4, size=size)
    expression = rng.normal(size=head.expression_basis.shape[2])
    return HeadPose(head.version, expression, turn(3), turn(3), turn(3), turn(6), rng.normal(size=3))


@pytest.mark.parametrize("blind", [False, True])
def test_vertices_are_those_of_the_definition(tmp_path, blind):
    content = gnm_content(blind=blind)
    head = load_head(write_gnm(tmp_path / "gnm_head.npz", content))
    assert head.version == "gnm-head-3.0"
    rng = np.random.default_rng(3)
    for _ in range(5):
        pose, identity = random_pose(head, rng), rng.normal(size=head.shape_basis.shape[2])
        rotations = np.stack([pose.rotation, pose.neck, pose.eyes[:3], pose.eyes[3:]])
        expected = gnm_vertices(content, identity, pose.expression, rotations, pose.translation)
        assert np.abs(head(pose, identity) - expected).max() < 1e-7  # 0.1 micrometres


def test_regressor_is_kept_if_expressions_do_not_move_joints():
    content = gnm_content(blind=True)
    head = gnm_head("gnm.npz", content)
    np.testing.assert_array_equal(head.joint_regressor[[0, 1, 3, 4]], content["joint_regressor"])
    moved = gnm_head("gnm.npz", gnm_content()).joint_regressor[[0, 1, 3, 4]]
    assert np.abs(moved - content["joint_regressor"]).max() > 1e-6
    np.testing.assert_allclose(moved.sum(axis=1), 1, atol=1e-8)


def test_jaw_moves_nothing():
    head = gnm_head("gnm.npz", gnm_content())
    pose = random_pose(head, np.random.default_rng(0))
    np.testing.assert_array_equal(head(pose), head(replace(pose, jaw=np.zeros(3))))


def test_a_head_without_a_jaw_is_fitted():
    source = procedural_head("2023")
    head = gnm_head("gnm.npz", gnm_content(source))
    clip = performance(source, 4)
    derived = refit(clip, head)
    assert {pose.head_model for pose in derived.clip.poses.values()} == {head.version}
    assert derived.report.summary()["mean_mm"] < 0.5  # expressions take over what the jaw did, 0.2 mm


def test_regions_have_the_names_of_flames_masks(tmp_path):
    source = toy_head(version="source")
    head = load_head(write_gnm(tmp_path / "gnm_head.npz"))
    for name in ("lips", "left_eyeball", "right_eyeball"):
        np.testing.assert_array_equal(head.regions[name], source.regions[name])
    eyeballs = np.concatenate([source.regions["left_eyeball"], source.regions["right_eyeball"]])
    face = np.setdiff1d(np.union1d(source.regions["face"], source.regions["lips"]), eyeballs)
    np.testing.assert_array_equal(head.regions["face"], face)
    np.testing.assert_array_equal(head.regions["eyeballs"], np.sort(eyeballs))
    assert "teeth" not in head.regions  # the file has no such group


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"variant": np.array("body")}, "variant"),
        ({"joint_names": np.array(["neck", "jaw", "left_eye", "right_eye"])}, "joint_names"),
        ({"joint_parent_indices": np.array([0, 0, 0, 1])}, "joint_names"),
        ({"pose_correctives_regressor": np.ones((36, 3), np.float32)}, "pose_correctives_regressor"),
        ({"skinning_weights": None}, "skinning_weights"),
        ({"joint_regressor": np.zeros((4, 7))}, "joint_regressor"),
    ],
)
def test_other_arrays_are_refused(change, key):
    content = {name: value for name, value in (gnm_content() | change).items() if value is not None}
    with pytest.raises(InputError) as caught:
        gnm_head("gnm.npz", content)
    assert caught.value.key == key


@pytest.mark.parametrize(
    ("vertices", "directions", "key"),
    [(0, 3, "template_vertex_positions"), (2, 1999, "vertex_identity_basis")],
)
def test_numbers_of_vertices_and_directions_have_bounds(vertices, directions, key):
    content = gnm_content() | {
        "template_vertex_positions": np.zeros((vertices, 3)),
        "vertex_identity_basis": np.zeros((directions, vertices, 3)),
        "joint_identity_basis": np.zeros((directions, 4, 3)),
        "expression_basis": np.zeros((2, vertices, 3)),
        "skinning_weights": np.zeros((4, vertices)),
        "joint_regressor": np.zeros((4, vertices)),
        "pose_correctives_regressor": np.zeros((36, 3 * vertices)),
        "vertex_groups": np.zeros((6, vertices)),
    }
    with pytest.raises(InputError) as caught:
        gnm_head("gnm.npz", content)
    assert caught.value.key == key


def test_correctives_of_the_root_are_refused():
    content = gnm_content()
    content["pose_correctives_regressor"][4, 0] = 1e-3
    with pytest.raises(InputError, match="turns the whole head"):
        gnm_head("gnm.npz", content)


def test_joints_that_no_weights_give_are_refused():
    content = gnm_content()
    content["vertex_identity_basis"][0] = 0  # an identity that moves joints but no vertices
    with pytest.raises(InputError, match="m off") as caught:
        gnm_head("gnm.npz", content)
    assert caught.value.key == "joint_identity_basis"


def test_only_files_of_the_layout_are_taken_for_one():
    assert is_gnm(gnm_content())
    assert not is_gnm({"template": np.zeros(3), "vertex_identity_basis": np.zeros(3)})
