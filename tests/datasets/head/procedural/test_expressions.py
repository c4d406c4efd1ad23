"""Expressions and identities of the default head: their algebra and what they do to the face."""

import numpy as np
import pytest

from headbench.datasets.head.procedural.expressions import SEMANTIC_NAMES, principal_basis
from headbench.datasets.head.procedural.versions import semantic_to_coefficients, version_shapes

from ..skinning import skinned

EYE_RADIUS = 0.012


@pytest.fixture(scope="module")
def matrices():
    return {version: semantic_to_coefficients(version) for version in ("procedural2020", "procedural2023")}


@pytest.fixture(scope="module")
def shapes(surface):
    return {version: version_shapes(surface, version) for version in ("procedural2020", "procedural2023")}


@pytest.fixture(scope="module")
def play(matrices):
    """Expression coefficients of named activations in the 2023 version."""

    def coefficients(**activations):
        values = np.zeros(len(SEMANTIC_NAMES))
        for name, value in activations.items():
            values[SEMANTIC_NAMES.index(name)] = value
        return values @ matrices["procedural2023"][0]

    return coefficients


def test_coefficients_play_exactly_the_named_shapes(heads, matrices, shapes):
    for version, head in heads.items():
        matrix, lids = matrices[version]
        for name, shape in shapes[version].items():
            row = SEMANTIC_NAMES.index(name)
            played = head.expression_basis @ matrix[row]
            if lids is not None:
                played = played + head.eyelid_basis @ lids[row]
            np.testing.assert_allclose(played, shape, atol=2e-6)


def test_principal_basis_has_the_covariance_of_its_activations():
    """Displacements drawn through the basis and through the shapes have the same second moments."""
    random = np.random.default_rng(0)
    shapes = {str(k): random.normal(size=(5, 3)) for k in range(3)}
    basis = principal_basis(shapes, np.array([0.5, 1.0, 2.0]), seed=1)
    stack = np.stack([field.ravel() for field in shapes.values()])
    inverse = np.linalg.inv(basis.from_semantic)  # coefficients -> activations
    flat = basis.directions.reshape(-1, 3)
    np.testing.assert_allclose(flat @ flat.T, stack.T @ (inverse.T @ inverse) @ stack, rtol=3e-5)


def test_versions_share_topology_and_differ_in_bases(heads, play):
    old, new = heads["procedural2020"], heads["procedural2023"]
    np.testing.assert_array_equal(old.faces, new.faces)
    np.testing.assert_array_equal(old.template, new.template)
    assert old.eyelid_basis is not None
    assert new.eyelid_basis is None
    k = min(old.expression_basis.shape[2], new.expression_basis.shape[2])
    assert np.abs(old.expression_basis[..., :k] - new.expression_basis[..., :k]).max() > 1e-3
    assert np.abs(old.shape_basis - new.shape_basis).max() > 1e-3
    # The 2020 directions cannot play 2023's shapes without a rest: a refit has something to lose.
    flat = old.expression_basis.reshape(-1, old.expression_basis.shape[2]).astype(np.float64)
    smile = (new.expression_basis @ play(smile_left=1.0)).ravel()
    rest = smile - flat @ np.linalg.lstsq(flat, smile, rcond=None)[0]
    assert 1e-3 < np.linalg.norm(rest) / np.linalg.norm(smile) < 0.5


def lid_gap(head, vertices, surface):
    """Largest height of the visible opening of the left eye: margin vertices matched across by x."""
    ball = head.regions["left_eyeball"]
    center = head.template[ball].mean(axis=0)
    rest = head.template - center
    near = np.linalg.norm(rest, axis=1) < EYE_RADIUS + 0.0022
    near &= (np.arange(len(rest)) < surface.skin_count) & (rest[:, 2] > 0.002)
    gaps = []
    for x in np.linspace(-0.009, 0.009, 13):
        column = near & (np.abs(rest[:, 0] - x) < 0.0012)
        upper, lower = column & (rest[:, 1] > 0), column & (rest[:, 1] < 0)
        gaps.append(vertices[upper, 1].min() - vertices[lower, 1].max())
    return max(gaps)


def test_blink_closes_the_eye(heads, surface, play):
    head = heads["procedural2023"]
    assert 0.008 < lid_gap(head, head.template, surface) < 0.014
    assert lid_gap(head, skinned(head, play(blink_left=1.0)), surface) < 0.0015
    old = heads["procedural2020"]
    assert lid_gap(old, old.template + old.eyelid_basis[:, :, 0], surface) < 0.0015


@pytest.mark.parametrize("share", [0.25, 0.5, 0.75, 1.0])
def test_lids_slide_over_the_eyeball(head, surface, play, share):
    vertices = skinned(head, play(blink_left=share, blink_right=share))
    for name in ("left_eyeball", "right_eyeball"):
        center = head.template[head.regions[name]].mean(axis=0)
        depth = EYE_RADIUS - np.linalg.norm(vertices[: surface.skin_count] - center, axis=1)
        assert depth.max() < 0.0005


def test_shapes_are_symmetric_in_pairs_and_leave_the_eyeballs(surface, shapes):
    shapes = shapes["procedural2023"]
    for name, shape in shapes.items():
        other = name
        for one, two in (("_left", "_right"), ("_right", "_left")):
            if name.endswith(one):
                other = name.removesuffix(one) + two
        np.testing.assert_allclose(surface.mirrored(shape), shapes[other], atol=1e-9)
        assert not shape[surface.skin_count :].any()
        assert 0.0008 < np.linalg.norm(shape, axis=1).max() < 0.015, name


def test_shapes_move_the_face_as_they_are_called(head, shapes):
    shapes = shapes["procedural2023"]
    x, y = 0, 1
    for name, place, axis, millimetres in (
        ("smile_left", "left_mouth_corner", x, 4),
        ("smile_left", "left_mouth_corner", y, 3),
        ("mouth_frown", "left_mouth_corner", y, -4),
        ("pucker", "left_mouth_corner", x, -4),
        ("mouth_left", "left_mouth_corner", x, 2),
        ("brow_inner_up", "left_brow_inner", y, 3),
        ("brow_down_left", "left_brow_inner", y, -2),
        ("brow_outer_up_left", "left_brow_outer", y, 3),
    ):
        moved = 1000 * shapes[name][head.landmarks[place], axis]
        assert moved / millimetres > 1, (name, place)
    assert np.linalg.norm(shapes["smile_left"][head.landmarks["right_mouth_corner"]]) < 1e-4
    upper, lower = (head.regions[f"lip_outside_ring_{part}"][7] for part in ("upper", "lower"))
    assert shapes["lips_part"][upper, y] > 0.001 > -0.001 > shapes["lips_part"][lower, y]
