"""Head arrays: what validation refuses, and the npz round trip."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.contracts import HeadAsset
from headbench.bench.errors import InputError
from headbench.datasets.head.arrays import (
    faces_in_region,
    read_head,
    region,
    save_head,
    with_derived_regions,
)

from .toy import toy_head

HEAD = toy_head(16, eyelids=True)


def spoiled(array, index, value):
    copy = array.copy()
    copy[index] = value
    return copy


BAD = {
    "NaN in template": ("template", {"template": spoiled(HEAD.template, (3, 1), np.nan)}),
    "infinite basis": ("shape_basis", {"shape_basis": spoiled(HEAD.shape_basis, (0, 0, 0), np.inf)}),
    "a number that leaves float32": ("pose_basis", {"pose_basis": spoiled(HEAD.pose_basis, (0, 0, 0), 1e38)}),
    "one vertex far away": ("template", {"template": spoiled(HEAD.template, (3, 1), -11.0)}),
    "a head as large as a house": ("template", {"template": HEAD.template * 40}),
    "a surface without area": ("template", {"faces": np.zeros_like(HEAD.faces)}),
    "integer template": ("template", {"template": np.zeros(HEAD.template.shape, int)}),
    "flat template": ("template", {"template": HEAD.template[:, :2]}),
    "short basis": ("expression_basis", {"expression_basis": HEAD.expression_basis[:-1]}),
    "root in pose basis": ("pose_basis", {"pose_basis": np.zeros((len(HEAD.template), 3, 45))}),
    "sideways regressor": ("joint_regressor", {"joint_regressor": HEAD.joint_regressor.T}),
    "face beyond vertices": ("faces", {"faces": spoiled(HEAD.faces, (0, 0), len(HEAD.template))}),
    "negative face": ("faces", {"faces": spoiled(HEAD.faces, (0, 0), -1)}),
    "quads": ("faces", {"faces": np.zeros((4, 4), int)}),
    "real faces": ("faces", {"faces": HEAD.faces.astype(float)}),
    "no faces": ("template", {"faces": HEAD.faces[:0]}),
    "loop in the tree": ("parents", {"parents": np.array([-1, 2, 1, 1, 1])}),
    "two roots": ("parents", {"parents": np.array([-1, 0, -1, 1, 1])}),
    "own parent": ("parents", {"parents": np.array([-1, 1, 1, 1, 1])}),
    "parents that are no integers": ("parents", {"parents": np.array([-1, 0, 1, 1, np.nan])}),
    "no root": ("parents", {"parents": np.array([0, 0, 1, 1, 1])}),
    "weights": ("skinning_weights", {"skinning_weights": spoiled(HEAD.skinning_weights, (7, 0), 0.99)}),
    "eyelids": ("eyelid_basis", {"eyelid_basis": HEAD.eyelid_basis[:, :, :1]}),
    "region beyond vertices": ("regions[x]", {"regions": {"x": np.array([0, 10**6])}}),
    "negative region": ("regions[x]", {"regions": {"x": np.array([-1, 0])}}),
    "unsorted region": ("regions[x]", {"regions": {"x": np.array([2, 1])}}),
    "repeated region": ("regions[x]", {"regions": {"x": np.array([1, 1])}}),
    "mask as region": ("regions[x]", {"regions": {"x": np.zeros(5, bool)}}),
    "landmark": ("landmarks[x]", {"landmarks": {"x": len(HEAD.template)}}),
}


@pytest.mark.parametrize("name", BAD)
def test_validate_refuses(name):
    key, change = BAD[name]
    with pytest.raises(InputError) as caught:
        replace(HEAD, **change).validate("some file")
    assert caught.value.file == "some file"
    assert caught.value.key == key


def test_valid_heads_pass_and_fit_the_contract():
    assert HEAD.validate("toy") is HEAD
    assert isinstance(HEAD, HeadAsset)
    ring = {"lip_outside_ring_upper": np.array([5, 3, 9])}
    assert replace(HEAD, regions=ring).validate("toy").regions == ring


@pytest.mark.parametrize("eyelids", [False, True])
def test_round_trip(tmp_path, eyelids):
    head = toy_head(16, seed=3, eyelids=eyelids, version="flame2020", dtype=np.float32)
    save_head(tmp_path / "head.npz", head)
    again = read_head(tmp_path / "head.npz")
    np.testing.assert_equal(vars(again), vars(head))
    assert again.template.dtype == np.float32
    assert again.fingerprint() == head.fingerprint()
    assert [path.name for path in tmp_path.iterdir()] == ["head.npz"]


def test_fingerprint_sees_every_part():
    changes = [
        {"version": "other"},
        {"template": spoiled(HEAD.template, (0, 0), 0.5)},
        {"eyelid_basis": None},
        {"regions": {}},
        {"landmarks": {"nose_tip": 0}},
    ]
    prints = {replace(HEAD, **change).fingerprint() for change in changes} | {HEAD.fingerprint()}
    assert len(prints) == len(changes) + 1


@pytest.mark.parametrize("missing", ["format", "template", "version", "landmark_names"])
def test_read_names_what_is_missing(tmp_path, missing):
    save_head(tmp_path / "head.npz", HEAD)
    with np.load(tmp_path / "head.npz") as archive:
        content = {name: archive[name] for name in archive.files if name != missing}
    np.savez(tmp_path / "less.npz", **content)
    with pytest.raises(InputError) as caught:
        read_head(tmp_path / "less.npz")
    assert caught.value.key == missing


def test_read_refuses_other_files(tmp_path):
    save_head(tmp_path / "head.npz", HEAD)
    whole = (tmp_path / "head.npz").read_bytes()
    np.savez(tmp_path / "objects.npz", format=np.array([{}], dtype=object))
    objects = (tmp_path / "objects.npz").read_bytes()
    for content in (whole[: len(whole) // 2], b"not an archive", b"", objects):
        (tmp_path / "other.npz").write_bytes(content)
        with pytest.raises(InputError):
            read_head(tmp_path / "other.npz")


def test_derived_regions_are_the_sets_they_name():
    sets = {name: set(members.tolist()) for name, members in HEAD.regions.items()}
    derived = {name: set(members) for name, members in with_derived_regions(HEAD).regions.items()}
    assert derived["hair"] == sets["scalp"] - (sets["face"] | sets["neck"])
    assert derived["ears"] == sets["left_ear"] | sets["right_ear"]
    assert derived["eyeballs"] == sets["left_eyeball"] | sets["right_eyeball"]
    assert derived["left_eye"] == sets["left_eye_region"] | sets["left_eyeball"]
    everything = set(range(len(HEAD.template)))
    assert derived["skin"] == everything - derived["hair"] - derived["eyeballs"] - sets["lips"]
    assert derived["hair"]
    with_derived_regions(HEAD).validate("toy")


def test_only_what_follows_is_derived():
    def derived(**regions):
        given = {name: np.array(members) for name, members in regions.items()}
        return {*with_derived_regions(replace(HEAD, regions=given)).regions} - {*given}

    assert derived() == derived(left_ear=[1], scalp=[2], face=[3]) == set()
    assert derived(left_ear=[1], right_ear=[2]) == {"ears"}
    assert derived(left_ear=[1], right_ear=[2], ears=[7]) == set()


def test_faces_have_all_three_vertices_inside():
    face = set(HEAD.regions["face"])
    expected = [index for index, triangle in enumerate(HEAD.faces) if set(triangle) <= face]
    assert 0 < len(expected) < len(HEAD.faces)
    np.testing.assert_array_equal(faces_in_region(HEAD, "face"), expected)
    np.testing.assert_array_equal(region(HEAD, "face"), HEAD.regions["face"])
    with pytest.raises(InputError, match=r"regions\[beard\].*FLAME_masks.pkl"):
        region(HEAD, "beard")
    with pytest.raises(InputError, match="beard"):
        faces_in_region(HEAD, "beard")
