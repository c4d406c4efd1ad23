"""Loading by content: FLAME pickles of both kinds, our npz, masks and further files."""

import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.datasets.head.arrays import RING_REGIONS, STORED, read_head, save_head
from headbench.datasets.head.loaders import CHART_FILES, EYELID_FILES, flame_version, load_head, read_chart
from headbench.datasets.head.teeth import with_teeth

from .flame_files import flame_content, legacy_pickle, write_flame
from .flame_stand_in import LID, lids, masks, write_stand_in
from .toy import toy_head

HEAD = toy_head()
UV = np.random.default_rng(4).random((len(HEAD.faces), 3, 2)).astype(np.float32)
EXTRA = "f 1/1 2/2 9/3\n"


def obj_text(faces, uv, seed=0):
    """An OBJ of the triangles in random order, each beginning at a random corner."""
    rng = np.random.default_rng(seed)
    lines, triangles = ["v 0 0 0"], []
    for number, (corners, places) in enumerate(zip(faces, uv)):
        lines += [f"vt {u:.9g} {v:.9g}" for u, v in places]
        named = [f"{corner + 1}/{3 * number + k + 1}/1" for k, corner in enumerate(corners)]
        start = rng.integers(3)
        triangles.append("f " + " ".join(named[start:] + named[:start]))
    return "\n".join(lines + [triangles[row] for row in rng.permutation(len(triangles))]) + "\n"


def test_triangles_are_found_in_any_order(tmp_path):
    path = tmp_path / "chart.obj"
    path.write_text(obj_text(HEAD.faces, UV).replace("\nvt ", "\n vt\t") + EXTRA)
    np.testing.assert_array_equal(read_chart(path, HEAD.faces), UV)


@pytest.mark.parametrize("name", CHART_FILES)
def test_the_file_beside_a_flame_pickle_is_the_chart(tmp_path, name):
    path = write_stand_in(tmp_path)
    head = load_head(path)
    assert head.uv is None
    uv = np.random.default_rng(0).random((len(head.faces), 3, 2)).astype(np.float32)
    (tmp_path / name).write_text(obj_text(head.faces, uv))
    charted = load_head(path)
    np.testing.assert_array_equal(charted.uv, uv)
    assert charted.fingerprint() != head.fingerprint()
    assert replace(charted, uv=None).fingerprint() == head.fingerprint()
    given = load_head(path, chart=tmp_path / name)
    assert given.fingerprint() == charted.fingerprint()


@pytest.mark.parametrize(
    "text",
    [
        *("", "v 0 0 0\nf 1 2 3\n", "vt 0 0\nf 1/1 2/2 3/3\n", "vt 0 0\nf 1/1 2/1 3/1 4/1\n"),
        *("vt 0 0\n" + 3 * "f 1/1 2/1 3/1 4/1\n", "vt 0 0\nf 1//1 2//1 3//1\n", "vt 0 0\nf 1/-1 2/1 3/1\n"),
        *("vt nan 0\nf 1/1 2/1 3/1\n", "vt 1e39 0\nf 1/1 2/1 3/1\n", "vt 0 0\nf 1/1 2/1 3/1\n"),
    ],
)
def test_other_files_are_refused(tmp_path, text):
    path = tmp_path / "chart.obj"
    path.write_text(text)
    with pytest.raises(InputError, match="chart.obj"):
        read_chart(path, HEAD.faces)


def test_a_chart_is_stored(tmp_path):
    charted = replace(HEAD, uv=UV)
    save_head(tmp_path / "head.npz", charted)
    read = read_head(tmp_path / "head.npz")
    np.testing.assert_array_equal(read.uv, UV)
    assert read.fingerprint() == charted.fingerprint()
    with pytest.raises(InputError, match="uv"):
        replace(HEAD, uv=UV[1:]).validate("head")


def test_teeth_have_no_place_in_the_chart():
    charted = with_teeth(replace(HEAD, uv=UV))
    np.testing.assert_array_equal(charted.uv[: len(UV)], UV)
    assert len(charted.uv) == len(charted.faces)
    assert not charted.uv[len(UV) :].any()


FLAME = toy_head(16, shape_size=300, expression_size=100)
RINGS = {name: FLAME.regions[name] for name in RING_REGIONS}
MASKS = {name: members for name, members in FLAME.regions.items() if name not in RINGS}


@pytest.mark.parametrize("legacy", [True, False])
def test_flame_pickle(tmp_path, legacy):
    head = load_head(write_flame(tmp_path / "generic_model.pkl", FLAME, legacy=legacy))
    assert head.version == "flame2020"
    for name in STORED:
        np.testing.assert_array_equal(getattr(head, name), getattr(FLAME, name))
    assert head.regions == {}


@pytest.mark.parametrize(
    ("name", "version"),
    [
        *(("generic_model.pkl", "flame2020"), ("FLAME2020.pkl", "flame2020"), ("flame2023.pkl", "flame2023")),
        *(("FLAME-2023.pkl", "flame2023"), ("flame2023_no_jaw.pkl", "flame2023_no_jaw")),
        *(("FLAME2020/male_model.pkl", "flame2020"), ("flame_2023/model.pkl", "flame2023")),
        *(
            ("FLAME2020/generic_model.pkl", "flame2020"),
            ("generic_model_20231005_flame2020.pkl", "flame2020"),
        ),
    ],
)
def test_version_by_name(name, version):
    assert flame_version(Path("some/where") / name) == version


@pytest.mark.parametrize(
    "name", ["FLAME2023/generic_model.pkl", "generic_20231005.pkl", "2020_to_2023.pkl", "FLAME_NEUTRAL.pkl"]
)
def test_version_is_not_guessed(name):
    with pytest.raises(InputError, match="Rename the file"):
        flame_version(Path("some/where") / name)


def test_version_is_asked_for_where_the_name_is_silent(tmp_path):
    path = write_flame(tmp_path / "model.pkl", FLAME)
    with pytest.raises(InputError, match="not interchangeable") as caught:
        load_head(path)
    assert caught.value.key == "version"
    assert load_head(path, version="flame2023").version == "flame2023"


@pytest.mark.parametrize(
    "name", ["flame2023_Open.pkl", "flame2023.pkl", "FLAME2020/generic_model.pkl", "model.pkl"]
)
def test_flame_2023_open_is_known_by_its_content(tmp_path, name):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    head = replace(FLAME, version="flame2023_open")
    assert load_head(write_flame(path, head)).version == "flame2023_open"
    stated = load_head(path, version="flame2023_open")
    np.testing.assert_array_equal(stated.expression_basis, head.expression_basis)
    with pytest.raises(InputError, match="'flame2023', found 'flame2023_open'"):
        load_head(path, version="flame2023")


def test_masks_and_regions(tmp_path):
    path = write_flame(tmp_path / "flame2023.pkl", FLAME)
    shuffled = {name: np.random.default_rng(0).permutation(members) for name, members in MASKS.items()}
    (tmp_path / "FLAME_masks.pkl").write_bytes(legacy_pickle(shuffled))
    rings = {name: members[::-1].tolist() for name, members in RINGS.items()}
    (tmp_path / "rings.json").write_text(json.dumps(rings))
    head = load_head(path, masks=tmp_path / "FLAME_masks.pkl", regions=tmp_path / "rings.json")
    for name, members in MASKS.items():
        np.testing.assert_array_equal(head.regions[name], members)
    for name in RING_REGIONS:
        np.testing.assert_array_equal(head.regions[name], rings[name])  # order kept
    assert {"hair", "ears", "eyeballs", "skin"} <= set(head.regions)


@pytest.mark.parametrize("place", [".", "FLAME_masks", "..", "../FLAME_masks"])
def test_what_belongs_to_a_flame_pickle_is_found(tmp_path, place):
    path = write_stand_in(tmp_path / "assets" / "FLAME2020", with_masks=False, with_eyelids=False)
    folder = path.parent / place
    write_stand_in(folder, "other.pkl")
    (path.parent / "regions.json").write_text(json.dumps({"mole": [3, 1]}))
    (path.parent.parent / "regions.json").write_text(json.dumps({"countries": ["DE"]}))  # of something else
    head = load_head(path)
    np.testing.assert_array_equal(head.regions["lips"], masks()["lips"])
    np.testing.assert_array_equal(head.regions["mole"], [1, 3])
    np.testing.assert_array_equal(head.eyelid_basis, np.stack(lids(), axis=2))
    assert float(np.abs(head.eyelid_basis).max()) == pytest.approx(LID)


def test_eyelids_of_another_folder_may_be_named(tmp_path):
    path = write_stand_in(tmp_path / "a" / "b", with_eyelids=False)
    write_stand_in(tmp_path / "lids")
    for given in (tmp_path / "lids", tmp_path / "lids" / EYELID_FILES[1]):
        np.testing.assert_array_equal(load_head(path, eyelids=given).eyelid_basis, np.stack(lids(), axis=2))
    with pytest.raises(InputError, match="l_eyelid.npy"):
        load_head(path, eyelids=tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        lambda lid: lid.unlink(),
        lambda lid: np.save(lid, np.zeros((7, 3))),
        lambda lid: np.save(lid, lids()[0] * np.nan),
        lambda lid: lid.write_bytes(b"x"),
    ],
)
def test_eyelids_are_checked(tmp_path, change):
    path = write_stand_in(tmp_path / "a")
    change(path.parent / "r_eyelid.npy")
    with pytest.raises(InputError, match="eyelid"):
        load_head(path)


def test_our_npz_round_trip(tmp_path):
    head = load_head(write_flame(tmp_path / "flame2020.pkl", FLAME))
    save_head(tmp_path / "head.npz", head)
    again = load_head(tmp_path / "head.npz")
    assert again.fingerprint() == head.fingerprint()
    assert load_head(tmp_path / "head.npz", version="flame2020").version == "flame2020"
    with pytest.raises(InputError, match="flame2023"):
        load_head(tmp_path / "head.npz", version="flame2023")


def flame_without(**changes):
    content = flame_content(FLAME) | changes
    return {name: value for name, value in content.items() if value is not None}


BAD = [
    ("v_template", {"v_template": None}),
    ("shapedirs", {"shapedirs": FLAME.shape_basis}),
    ("f", {"f": FLAME.faces.astype(float)}),
    ("kintree_table", {"kintree_table": np.arange(5)}),
    ("kintree_table", {"kintree_table": np.zeros((0, 5), int)}),
    ("parents", {"kintree_table": np.array([[0, 0, 9, 1, 1], [0, 1, 2, 3, 4]])}),
    ("pose_basis", {"posedirs": FLAME.pose_basis[:, :, :9]}),
    ("pose_basis", {"posedirs": np.full_like(FLAME.pose_basis, 1e38)}),
    ("J_regressor", {"J_regressor": "text"}),
    ("skinning_weights", {"weights": 2 * FLAME.skinning_weights}),
    ("template", {"v_template": np.full_like(FLAME.template, np.nan)}),
]


@pytest.mark.parametrize(("key", "changes"), BAD)
def test_refuses_what_makes_no_head(tmp_path, key, changes):
    path = tmp_path / "flame2020.pkl"
    path.write_bytes(pickle.dumps(flame_without(**changes)))
    with pytest.raises(InputError) as caught:
        load_head(path)
    assert caught.value.file == str(path)
    assert caught.value.key == key


VALUES = ('"abc"', "[1.5]", "[true]", "[[1]]", "[1e9999]", "[99999999999999999999]")
BESIDE = {
    **{text: ("regions", text.encode()) for text in ("[1, 2]", "{", *(f'{{"x": {v}}}' for v in VALUES))},
    "masks of real numbers": ("masks", pickle.dumps({"face": np.array([0.5])})),
    "masks in a table": ("masks", pickle.dumps({"face": np.zeros((2, 2), int)})),
    "masks far away": ("masks", pickle.dumps({"face": np.array([10**6])})),
    "no masks": ("masks", None),
}


@pytest.mark.parametrize("name", BESIDE)
def test_files_beside_a_pickle_are_checked(tmp_path, name):
    option, content = BESIDE[name]
    path = write_flame(tmp_path / "flame2020.pkl", FLAME)
    if content is not None:
        (tmp_path / "beside.json").write_bytes(content)
    with pytest.raises(InputError, match="face" if content and option == "masks" else r"beside\.json"):
        load_head(path, **{option: tmp_path / "beside.json"})


def test_refuses_other_files(tmp_path):
    (tmp_path / "flame2020.pkl").write_text("solid head")
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    for name in ("flame2020.pkl", "other.npz", "none.npz", "."):
        with pytest.raises(InputError, match=name):
            load_head(tmp_path / name)
