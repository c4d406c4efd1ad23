"""Texture coordinates of a head model: from the OBJ file beside a FLAME pickle, stored, and kept by steps."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.datasets.head.arrays import read_head, save_head
from headbench.datasets.head.loaders import CHART_FILES, load_head, read_chart
from headbench.datasets.head.teeth import with_teeth

from .flame_stand_in import write_stand_in
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
