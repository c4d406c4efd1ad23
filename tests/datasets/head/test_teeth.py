"""Teeth: GaussianAvatars' counts, block order and geometry on any topology; lip rings found in the mesh."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from headbench.bench.errors import InputError
from headbench.datasets.head.arrays import RING_REGIONS
from headbench.datasets.head.model import HeadModel
from headbench.datasets.head.teeth import lip_rings, with_teeth

from .flame_stand_in import SIDES, masks, rings, stand_in
from .toy import toy_head

HEAD = toy_head(80, eyelids=True)

PUBLISHED = (
    "0 31 30, 0 1 31, 1 32 31, 1 2 32, 2 33 32, 2 3 33, 3 34 33, 3 4 34, 4 35 34, 4 5 35, 5 36 35, 5 6 36, "
    "6 37 36, 6 7 37, 7 8 37, 8 38 37, 8 9 38, 9 39 38, 9 10 39, 10 40 39, 10 11 40, 11 41 40, 11 12 41, "
    "12 42 41, 12 13 42, 13 43 42, 13 14 43, 14 44 43, 60 75 76, 60 76 61, 61 76 77, 61 77 62, 62 77 78, "
    "62 78 63, 63 78 79, 63 79 64, 64 79 80, 64 80 65, 65 80 81, 65 81 66, 66 81 82, 66 82 67, 67 82 68, "
    "68 82 83, 68 83 69, 69 83 84, 69 84 70, 70 84 85, 70 85 71, 71 85 86, 71 86 72, 72 86 87, 72 87 73, "
    "73 87 88, 73 88 74, 74 88 89, 75 30 76, 76 30 31, 76 31 77, 77 31 32, 77 32 78, 78 32 33, 78 33 79, "
    "79 33 34, 79 34 80, 80 34 35, 80 35 81, 81 35 36, 81 36 82, 82 36 37, 82 37 38, 82 38 83, 83 38 39, "
    "83 39 84, 84 39 40, 84 40 85, 85 40 41, 85 41 86, 86 41 42, 86 42 87, 87 42 43, 87 43 88, 88 43 44, "
    "88 44 89, 45 46 15, 46 16 15, 46 47 16, 47 17 16, 47 48 17, 48 18 17, 48 49 18, 49 19 18, 49 50 19, "
    "50 20 19, 50 51 20, 51 21 20, 51 52 21, 52 22 21, 52 23 22, 52 53 23, 53 24 23, 53 54 24, 54 25 24, "
    "54 55 25, 55 26 25, 55 56 26, 56 27 26, 56 57 27, 57 28 27, 57 58 28, 58 29 28, 58 59 29, 90 106 105, "
    "90 91 106, 91 107 106, 91 92 107, 92 108 107, 92 93 108, 93 109 108, 93 94 109, 94 110 109, "
    "94 95 110, 95 111 110, 95 96 111, 96 112 111, 96 97 112, 97 98 112, 98 113 112, 98 99 113, "
    "99 114 113, 99 100 114, 100 115 114, 100 101 115, 101 116 115, 101 102 116, 102 117 116, 102 103 117, "
    "103 118 117, 103 104 118, 104 119 118, 105 106 45, 106 46 45, 106 107 46, 107 47 46, 107 108 47, "
    "108 48 47, 108 109 48, 109 49 48, 109 110 49, 110 50 49, 110 111 50, 111 51 50, 111 112 51, "
    "112 52 51, 112 53 52, 112 113 53, 113 54 53, 113 114 54, 114 55 54, 114 115 55, 115 56 55, "
    "115 116 56, 116 57 56, 116 117 57, 117 58 57, 117 118 58, 118 59 58, 118 119 59"
)
"""Triangles of the teeth in GaussianAvatars (flame_model/flame.py, commit 30cc4be), indices into the new vertices."""


def ringed(columns, reverse=False):
    """The toy with rings of a given length."""
    upper, lower = (HEAD.regions[name] for name in RING_REGIONS)
    step = -1 if reverse else 1
    rings = dict(zip(RING_REGIONS, (upper[:columns][::step], lower[:columns][::step])))
    return replace(HEAD, regions=HEAD.regions | rings)


def test_triangles_stand_in_the_published_order():
    """With rings of 15, from the left to the right, as published: 120 vertices and 168 triangles are added."""
    big = toy_head(96)
    rings = {name: big.regions[name][-2:0:-1] for name in RING_REGIONS}
    toothed = with_teeth(replace(big, regions=big.regions | rings)).validate("toothed")
    first = len(big.template)
    assert len(toothed.template) - first == 120
    published = [[int(vertex) for vertex in row.split()] for row in PUBLISHED.split(",")]
    np.testing.assert_array_equal(toothed.faces[len(big.faces) :] - first, published)
    upper = {*range(15), *range(30, 45), *range(60, 90)}
    assert set(toothed.regions["teeth_upper"] - first) == upper
    assert set(toothed.regions["teeth_lower"] - first) == set(range(120)) - upper


def test_positions_follow_the_recipe():
    columns = 11
    head = ringed(columns)
    upper, lower = (head.template[head.regions[name]] for name in RING_REGIONS)
    distance = np.mean([np.linalg.norm(a - b) for a, b in zip(upper, lower)])
    rows = with_teeth(head).template[len(HEAD.template) :].reshape(8, columns, 3)
    level = np.mean([(a[1] + b[1]) / 2 for a, b in zip(upper, lower)])
    for column in range(columns):
        x = (upper[column, 0] + lower[column, 0]) / 2
        z = (upper[column, 2] + lower[column, 2]) / 2 - 1.5 * distance
        expected = [
            (level + 2.1 * distance, z),
            (level - 2.1 * distance, z - 0.4 * distance),
            (level + 0.1 * distance, z),
            (level - 0.1 * distance, z - 0.4 * distance),
            (level + 2.1 * distance, z - distance),
            (level + 0.1 * distance, z - distance),
            (level - 2.1 * distance, z - 1.4 * distance),
            (level - 0.1 * distance, z - 1.4 * distance),
        ]
        np.testing.assert_allclose(rows[:, column, 0], x, atol=1e-15)
        np.testing.assert_allclose(rows[:, column, 1:], expected, atol=1e-15)


@pytest.mark.parametrize("reverse", [False, True])
def test_teeth_face_outwards(reverse):
    columns = 13
    toothed = with_teeth(ringed(columns, reverse))
    triangles = toothed.template[toothed.faces[len(HEAD.faces) :]].reshape(6, 2 * (columns - 1), 3, 3)
    normals = np.cross(triangles[:, :, 1] - triangles[:, :, 0], triangles[:, :, 2] - triangles[:, :, 0])
    outward = [(2, 1), (2, -1), (1, -1), (2, 1), (2, -1), (1, 1)]  # front +z, back -z, edges towards the gap
    for strip, (axis, sign) in zip(normals, outward):
        assert (sign * strip[:, axis] > 0).all()


def test_teeth_move_with_the_jaw_and_the_identity_alone():
    columns = 13
    head = with_teeth(ringed(columns))
    model = HeadModel(head, dtype=torch.float64)
    zero = {"rotation": 3, "neck": 3, "jaw": 3, "eyes": 6, "translation": 3, "expression": 8, "shape": 6}
    still = {name: torch.zeros(size, dtype=torch.float64) for name, size in zero.items()}
    upper, lower = head.regions["teeth_upper"], head.regions["teeth_lower"]
    rest = model(**still)[0].numpy()

    jaw = torch.tensor([0.3, 0.0, 0.0], dtype=torch.float64)
    opened = model(**still | {"jaw": jaw})[0].numpy()
    np.testing.assert_allclose(opened[upper], rest[upper], atol=1e-15)
    joint = model.joints(still["shape"], still["expression"])[0, 2].numpy()
    c, s = np.cos(0.3), np.sin(0.3)
    turn = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    np.testing.assert_allclose(opened[lower], (rest[lower] - joint) @ turn.T + joint, atol=1e-14)

    smiling = model(**still | {"expression": torch.ones(8, dtype=torch.float64)})[0].numpy()
    np.testing.assert_array_equal(smiling[upper], rest[upper])

    shape = torch.linspace(-1, 1, 6, dtype=torch.float64)
    moved = model.canonical(shape)[0].numpy() - rest
    rings = [head.regions[name] for name in RING_REGIONS]
    expected = 0.5 * (moved[rings[0]] + moved[rings[1]])
    for block in moved[len(HEAD.template) :].reshape(8, columns, 3):
        np.testing.assert_allclose(block, expected, atol=1e-15)

    plain = HeadModel(ringed(columns), dtype=torch.float64)
    a = still | {"jaw": jaw, "neck": 2 * jaw, "shape": shape}
    np.testing.assert_allclose(model(**a)[0, : len(HEAD.template)], plain(**a)[0], atol=1e-14)


def test_unequal_rings_are_refused():
    uneven = {"lip_outside_ring_upper": HEAD.regions["lip_outside_ring_upper"][1:]}
    with pytest.raises(InputError, match="one length"):
        with_teeth(replace(HEAD, regions=HEAD.regions | uneven))


def real_head():
    """A head with FLAME's masks, whose lips lie wholly inside the face."""
    return replace(stand_in(), regions=masks())


def test_rings_are_those_of_gaussianavatars_rule():
    """On FLAME the rule gives the two lists of that code, vertex by vertex; the stand-in has the same structure."""
    for found, expected in zip(lip_rings(real_head()), rings()):
        np.testing.assert_array_equal(found, expected)
    toothed = with_teeth(real_head()).validate("toothed")
    assert len(toothed.template) - len(stand_in().template) == 120


@pytest.mark.parametrize("where", ["outer lips alone in the face", "wall in the face", "no face"])
def test_rings_do_not_depend_on_how_far_the_face_reaches(where):
    regions = masks()
    if where == "no face":
        del regions["face"]
    elif where == "wall in the face":
        regions["face"] = np.arange(regions["face"].max() + 1)
    else:
        regions["face"] = regions["face"][2 * SIDES :]
    for found, expected in zip(lip_rings(replace(stand_in(), regions=regions)), rings()):
        np.testing.assert_array_equal(found, expected)


def test_missing_rings_are_explained():
    head = real_head()
    rest = {key: members for key, members in head.regions.items() if key != "lips"}
    with pytest.raises(InputError, match="lips"):
        lip_rings(replace(head, regions=rest))
    stiff = np.tile([0.0, 1, 0, 0, 0], (len(head.template), 1))
    with pytest.raises(InputError, match="jaw"):
        lip_rings(replace(head, skinning_weights=stiff))
    with pytest.raises(InputError, match="an upper and a lower lip"):
        lip_rings(replace(head, regions={"lips": np.arange(3)}))
