"""Derived regions by plain set algebra, and the triangles of a region."""

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.datasets.head.arrays import derived_regions, faces_in_region, with_derived_regions

from .toy import toy_head

HEAD = toy_head()


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


def test_hair_is_scalp_without_face_and_neck():
    parts = {"scalp": np.array([1, 2, 3, 4]), "face": np.array([2, 9]), "neck": np.array([3, 8])}
    np.testing.assert_array_equal(derived_regions(parts, 10)["hair"], [1, 4])


def test_only_what_follows_is_derived():
    assert derived_regions({}, 10) == {}
    some = {"left_ear": np.array([1]), "scalp": np.array([2]), "face": np.array([3])}
    assert derived_regions(some, 10) == {}
    given = {"left_ear": np.array([1]), "right_ear": np.array([2]), "ears": np.array([7])}
    assert "ears" not in derived_regions(given, 10)


def test_faces_have_all_three_vertices_inside():
    face = set(HEAD.regions["face"])
    expected = [index for index, triangle in enumerate(HEAD.faces) if set(triangle) <= face]
    assert 0 < len(expected) < len(HEAD.faces)
    np.testing.assert_array_equal(faces_in_region(HEAD, "face"), expected)
    with pytest.raises(InputError, match="beard"):
        faces_in_region(HEAD, "beard")
