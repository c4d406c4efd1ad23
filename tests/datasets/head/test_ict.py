"""ICT-FaceKit: the fitted rig against the kit's own blendshapes."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from headbench.bench.errors import InputError
from headbench.datasets.head.ict import (
    Hinge,
    expression_names,
    fit_hinge,
    hinge_correctives,
    hinge_weights,
    ict_head,
    read_ict,
)
from headbench.datasets.head.loaders import load_head
from headbench.datasets.head.model import HeadModel

FILE = Path(__file__).parents[4] / "shared" / "data" / "ict_facekit" / "ict_facekit_f16.npz"


@pytest.fixture(scope="module")
def content():
    if not FILE.exists():
        pytest.skip("ICT-FaceKit is not beside the repository (shared/data/ict_facekit)")
    with np.load(FILE, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


@pytest.fixture(scope="module")
def head(content):
    return load_head(FILE)


@pytest.fixture(scope="module")
def model(head):
    return HeadModel(head, dtype=torch.float64)


def displacement(content, name):
    index = [str(shape) for shape in content["expr_names"]].index(name)
    return content["expr_deltas"][index].astype(np.float64) * 0.01


def jaw_hinge(head, displacement):
    teeth = head.regions["teeth_lower"]
    return fit_hinge(head.template[teeth], head.template[teeth] + displacement[teeth])


def vertices(model, **given):
    sizes = {"shape": model.shape_size, "expression": model.expression_size}
    sizes |= {"rotation": 3, "neck": 3, "jaw": 3, "eyes": 6, "translation": 3}
    values = {name: torch.as_tensor(given.get(name, [0.0] * size)).double() for name, size in sizes.items()}
    return model(**values)[0].numpy()


@pytest.fixture(scope="module")
def joints(model):
    """(5, 3) at rest."""
    still = (torch.zeros(size).double() for size in (model.shape_size, model.expression_size))
    return model.joints(*still)[0].numpy()


def test_placement_is_metric_and_central(head, joints):
    nose, chin = (head.template[head.landmarks[name]] for name in ("ibug_30", "ibug_08"))
    assert nose[2] > 0.08
    assert chin[1] < -0.08
    assert head.template[head.landmarks["ibug_45"], 0] > 0.03  # subject's left is +x
    above_chin = head.template[head.template[:, 1] > chin[1]]
    np.testing.assert_allclose(above_chin.min(0) + above_chin.max(0), 0, atol=1e-9)
    assert 0.055 < np.ptp(joints[3:, 0]) < 0.07  # between the pupils


def test_expressions_and_identities_are_the_kits(head, model, content):
    names = expression_names(content)
    for name in (names[0], "eyeBlink_L", names[-1]):
        moved = vertices(model, expression=np.eye(len(names))[names.index(name)]) - head.template
        np.testing.assert_allclose(moved, displacement(content, name), atol=3e-8)
    moved = model.canonical(torch.eye(100, dtype=torch.float64)[7])[0].numpy() - head.template
    np.testing.assert_allclose(moved, content["id_deltas"][7].astype(np.float64) * 0.01, atol=1e-8)


def test_the_jaw_reproduces_jaw_open(head, model, joints, content):
    wanted = displacement(content, "jawOpen")
    jaw = jaw_hinge(head, wanted)
    assert 15 < np.degrees(jaw.angle) < 35
    np.testing.assert_allclose(joints[2], jaw.center, atol=1e-9)
    full = vertices(model, jaw=[jaw.angle, 0, 0]) - head.template
    assert np.linalg.norm(full - wanted, axis=1).max() < 1e-6
    # Half-way the teeth follow the arc, the linear blendshape the chord: 2.4 mm apart at most.
    half = vertices(model, jaw=[jaw.angle / 2, 0, 0]) - head.template
    assert np.linalg.norm(half - wanted / 2, axis=1).max() < 2.5e-3


def test_eyes_turn_about_their_centres(head, model, joints):
    turned = vertices(model, eyes=[0, 0.3, 0, 0, 0.3, 0])
    for side, joint in (("left", 3), ("right", 4)):
        ball = head.regions[f"{side}_sclera"]
        distance = np.linalg.norm(head.template[ball] - joints[joint], axis=1)
        back = head.template[ball, 2] < joints[joint, 2]
        assert np.ptp(distance[back]) < 0.1 * distance[back].mean()
        np.testing.assert_allclose(np.linalg.norm(turned[ball] - joints[joint], axis=1), distance, atol=1e-12)
        front = ball[np.argmax(head.template[ball, 2])]
        assert turned[front, 0] - head.template[front, 0] > 0.003  # to the subject's left


def test_regions(head):
    regions = {name: set(members.tolist()) for name, members in head.regions.items()}
    names = ("face", "eye_region", "lips", "scalp", "neck", "left_ear", "teeth_upper", "hair", "skin", "nose")
    assert all(regions[name] for name in names)
    assert not regions["face"] & (regions["neck"] | regions["left_ear"] | regions["right_ear"])
    assert regions["eye_region"] | regions["forehead"] <= regions["face"]
    assert regions["teeth_upper"] | regions["teeth_lower"] == regions["teeth"]
    assert not regions["teeth_upper"] & regions["teeth_lower"]
    assert {head.landmarks[f"ibug_{index:02d}"] for index in range(48, 60)} <= regions["lips"]
    assert {head.landmarks[f"ibug_{index:02d}"] for index in range(17, 68)} <= regions["face"]
    left = head.template[head.regions["left_ear"], 0]
    assert left.min() > 0.05
    assert abs(len(regions["left_ear"]) - len(regions["right_ear"])) < 5  # the kit is symmetric


BAD = {
    "v_neutral": lambda c: c["v_neutral"][:-1],
    "id_deltas": lambda c: None,
    "tri_v": lambda c: c["tri_v"].astype(float),
    "tri_material": lambda c: c["tri_material"] + 12,
    "expr_names": lambda c: np.array([str(name).upper() for name in c["expr_names"]]),
    "material_names": lambda c: np.array([str(name).upper() for name in c["material_names"]]),
    "idx_to_landmark_verts": lambda c: c["idx_to_landmark_verts"][:51],
}


@pytest.mark.parametrize("key", BAD)
def test_refuses_other_content(content, key):
    changed = content | {key: BAD[key](content)}
    changed = {name: value for name, value in changed.items() if value is not None}
    with pytest.raises(InputError) as caught:
        ict_head("kit.npz", changed)
    assert caught.value.file == "kit.npz"
    if key != "v_neutral":  # there it is the first array that disagrees
        assert caught.value.key == key


NEUTRAL = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0.5]], np.float32)
FACES = "usemtl M_Face\nf 1/1 2/2 3/3 4/4\nusemtl M_Back\nf 2/1/1 5/2/1 3/3/1\n"


def write_kit(folder, **moved):
    """A folder as the kit's: meshes with quads and materials, whose shapes move one vertex, and the list of landmarks."""
    folder.mkdir(parents=True)
    for name, vertex in {"generic_neutral_mesh": None, **moved}.items():
        vertices = NEUTRAL + 0.25 * (np.arange(5) == vertex)[:, None]
        rows = "".join(f"v {x:g} {y:g} {z:g}\n" for x, y, z in vertices) + "vt 0 0\nvn 0 0 1\n"
        (folder / f"{name}.obj").write_text(f"# kit\nmtllib kit.mtl\n{rows}{FACES}")
    (folder / "vertex_indices.json").write_text('{"idx_to_landmark_verts": [4, 0]}')
    return folder


def test_the_folder_of_the_kit_is_read(tmp_path):
    folder = write_kit(tmp_path / "kit" / "FaceXModel", jawOpen=4, browDown_L=1, identity000=2)
    for path in (folder, folder.parent):
        content = read_ict(path)
        np.testing.assert_array_equal(content["v_neutral"], NEUTRAL)
        np.testing.assert_array_equal(content["tri_v"], [[0, 1, 2], [0, 2, 3], [1, 4, 2]])
        assert content["material_names"][content["tri_material"]].tolist() == ["M_Face", "M_Face", "M_Back"]
        assert content["expr_names"].tolist() == ["browDown_L", "jawOpen"]
        for deltas, vertex in zip([*content["expr_deltas"], *content["id_deltas"]], (1, 4, 2)):
            np.testing.assert_array_equal(deltas, 0.25 * (np.arange(5) == vertex)[:, None] * np.ones(3))
        assert content["idx_to_landmark_verts"].tolist() == [4, 0]


@pytest.mark.parametrize(
    ("file", "change", "said"),
    [
        ("jawOpen.obj", lambda text: text.replace("v 0 0 0\n", ""), "5 vertices, as in generic_neutral_mesh"),
        ("jawOpen.obj", lambda text: text.replace("v 0 0 0", "v 0 zero 0"), "an OBJ mesh"),
        ("generic_neutral_mesh.obj", lambda text: text.replace("f 1/1", "f one/1"), "an OBJ mesh"),
        ("vertex_indices.json", lambda text: "{}", "lists of vertices by name"),
    ],
)
def test_damaged_files_of_the_kit_are_named(tmp_path, file, change, said):
    path = write_kit(tmp_path / "kit", jawOpen=4, identity000=2) / file
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError, match=said) as caught:
        load_head(tmp_path / "kit")
    assert caught.value.file == str(path)


def test_another_folder_is_no_kit(tmp_path):
    with pytest.raises(InputError, match="the folder FaceXModel of ICT-FaceKit"):
        load_head(tmp_path)


RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(60, 3))


@settings(max_examples=50, deadline=None)
@given(st.floats(0.01, 2.5), st.sampled_from([-1, 1]), st.floats(-3, 3), st.floats(-3, 3))
def test_hinge_is_recovered(angle, sign, y, z):
    center = np.array([0, y, z])
    moved = Rotation.from_rotvec([sign * angle, 0, 0]).apply(POINTS - center) + center
    hinge = fit_hinge(POINTS, moved)
    assert hinge.angle == pytest.approx(sign * angle, abs=1e-12)
    np.testing.assert_allclose(hinge.center, center, atol=1e-9)
    np.testing.assert_allclose(hinge.displacement(POINTS), moved - POINTS, atol=1e-12)


def test_a_pure_shift_is_no_hinge():
    with pytest.raises(ValueError, match="no centre"):
        fit_hinge(POINTS, POINTS + [0, 1, 0])


def test_weights_and_correctives_reproduce_any_displacement():
    hinge = Hinge(0.4, np.array([0.0, 0.2, -0.1]))
    share = RNG.uniform(0, 1, len(POINTS))
    np.testing.assert_allclose(
        hinge_weights(hinge, POINTS, share[:, None] * hinge.displacement(POINTS), 0.0), share
    )
    displacement = RNG.normal(size=POINTS.shape)
    weights = hinge_weights(hinge, POINTS, displacement, 0.1)
    assert weights.min() >= 0
    assert weights.max() <= 1
    basis = hinge_correctives(hinge, POINTS, displacement, weights)
    posed = POINTS + basis @ (hinge.matrix - np.eye(3)).ravel()
    skinned = posed + weights[:, None] * hinge.displacement(posed)
    np.testing.assert_allclose(skinned, POINTS + displacement, atol=1e-12)
    assert not basis[:, :, [0, 1, 2, 3, 4, 6, 8]].any()
