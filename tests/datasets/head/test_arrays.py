"""Head arrays: what validation refuses, and the npz round trip."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.contracts import HeadAsset, HeadPose
from headbench.bench.errors import InputError
from headbench.bench.expressions import expressions_of
from headbench.datasets.head.arrays import faces_in_region, read_head, region, save_head, with_derived_regions
from headbench.datasets.head.procedural.expressions import LIDS
from headbench.datasets.head.procedural.model import procedural_head
from headbench.datasets.head.procedural.surface import load_sculpture
from headbench.datasets.head.procedural.versions import version_shapes

from .toy import toy_head


@pytest.mark.parametrize("version", ["procedural2020", "procedural2023"])
def test_names_of_the_default_head_move_what_they_say(version):
    head = procedural_head(version)
    found = {shape.name: shape for shape in head.named_expressions()}
    shapes = version_shapes(load_sculpture(), version)
    for name, wanted in (
        ("smile", shapes["smile_left"] + shapes["smile_right"]),
        ("mouth sideways", shapes["mouth_left"] - shapes["mouth_right"]),
        ("pucker", shapes["pucker"]),
    ):
        moved = head.expression_basis @ found[name].direction
        assert np.abs(moved - wanted).max() < 0.05 * np.abs(wanted).max() + 1e-5
    assert ("blink" in found) == (version == "procedural2023")
    assert {*LIDS}.isdisjoint(found)


def test_the_strongest_expressions_come_first():
    head = procedural_head()
    found = expressions_of(head, 6, ())
    moved = [np.linalg.norm(head.expression_basis @ shape.direction, axis=1).max() for shape in found]
    assert moved == sorted(moved, reverse=True)
    assert len(found) == 6


def test_models_without_names_have_single_coefficients():
    head = toy_head(16)
    size = head.expression_basis.shape[2]
    none = np.zeros(3)
    largest = np.linspace(0.1, 0.2, size)
    pose = HeadPose(head.version, -largest, none, none, none, np.zeros(6), none)
    for shape in expressions_of(head, size, [pose]):
        number = int(shape.direction.argmax())
        assert shape.name == f"expression {number + 1}"
        assert shape.high == -shape.low == pytest.approx(1.5 * largest[number], abs=1e-4)


def test_names_are_kept_in_files_and_sides_are_paired(tmp_path):
    head = toy_head(16)
    size = head.expression_basis.shape[2]
    names = ("frown_L", "frown_R", *(f"shape{number}" for number in range(size - 2)))
    save_head(tmp_path / "head.npz", replace(head, expression_names=names))
    read = read_head(tmp_path / "head.npz")
    assert read.expression_names == names
    first, *others = read.named_expressions()
    assert first.name == "frown"
    assert first.direction.tolist() == [1.0, 1.0] + [0.0] * (size - 2)
    assert len(others) == size - 2
    with pytest.raises(InputError, match="expression_names"):
        replace(head, expression_names=names[1:]).validate("head")


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
