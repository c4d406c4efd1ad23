"""Head arrays: what validation refuses, and the npz round trip."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.contracts import HeadAsset
from headbench.bench.errors import InputError
from headbench.datasets.head.arrays import faces_in_region, read_head, region, save_head, with_derived_regions

from .toy import toy_head

HEAD = toy_head(16, eyelids=True)


def spoiled(array, index, value):
    copy = array.copy()
    copy[index] = value
    return copy


PARENTS = ([-1, 2, 1, 1, 1], [-1, 0, -1, 1, 1], [-1, 1, 1, 1, 1], [-1, 0, 1, 1, np.nan], [0, 0, 1, 1, 1])
BAD = [
    *(("template", spoiled(HEAD.template, (3, 1), value)) for value in (np.nan, -11.0)),
    *(("template", HEAD.template * 40), ("template", np.zeros(HEAD.template.shape, int))),
    *(("template", HEAD.template[:, :2]), ("expression_basis", HEAD.expression_basis[:-1])),
    *((name, spoiled(getattr(HEAD, name), (0, 0, 0), 1e38)) for name in ("pose_basis", "shape_basis")),
    *(
        ("shape_basis", spoiled(HEAD.shape_basis, (0, 0, 0), np.inf)),
        ("joint_regressor", HEAD.joint_regressor.T),
    ),
    ("pose_basis", np.zeros((len(HEAD.template), 3, 45))),
    *(("faces", spoiled(HEAD.faces, (0, 0), value)) for value in (len(HEAD.template), -1)),
    *(("faces", np.zeros((4, 4), int)), ("faces", HEAD.faces.astype(float))),
    *(("parents", np.array(parents)) for parents in PARENTS),
    ("skinning_weights", spoiled(HEAD.skinning_weights, (7, 0), 0.99)),
    *(("eyelid_basis", HEAD.eyelid_basis[:, :, :1]), ("landmarks[x]", len(HEAD.template))),
    *(("regions[x]", np.array(members)) for members in ([0, 10**6], [-1, 0], [2, 1], [1, 1], [False] * 5)),
]


@pytest.mark.parametrize(("key", "value"), BAD)
def test_validate_refuses(key, value):
    name = key.removesuffix("[x]")
    with pytest.raises(InputError) as caught:
        replace(HEAD, **{name: value if name == key else {"x": value}}).validate("some file")
    assert (caught.value.file, caught.value.key) == ("some file", key)


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
