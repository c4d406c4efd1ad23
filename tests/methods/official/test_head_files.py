"""A head model as their code is given it: padded and renumbered, the same head all the same."""

import pickle
import sys

import numpy as np
import pytest
import scipy.sparse

from headbench.bench.contracts import Camera
from headbench.bench.io.files import write_bytes
from headbench.bench.process import run_program
from headbench.datasets.head.teeth import lip_rings, with_teeth
from headbench.methods.official.ga.head_files import (
    TEMPLATE_FILE,
    OfficialHead,
    OfficialTracking,
    SparseMatrix,
    around,
    inside,
    pickled,
)
from headbench.methods.official.ga.method import MARK_STEP, mark

from ...datasets.head.toy import toy_head


def camera(cx, cy, width=550, height=802, focal=2050.0):
    turn, _ = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn * np.sign(np.linalg.det(turn)), (0.01, 0.02, 1.0)
    return Camera("a", width, height, np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1.0]]), motion)


def project(camera, points):
    local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = local @ camera.K.T
    return pixels[:, :2] / pixels[:, 2:]


def points_on(camera):
    """Points in the world behind a grid of the camera's pixels."""
    grid = np.stack(
        np.meshgrid(np.linspace(0, camera.width, 9), np.linspace(0, camera.height, 9)), -1
    ).reshape(-1, 2)
    rays = (grid - camera.K[:2, 2]) / camera.K[0, 0]
    local = np.column_stack([rays, np.ones(len(rays))]) - camera.world_to_camera[:3, 3]
    return grid, local @ camera.world_to_camera[:3, :3]


CENTERS = [(275.0, 401.0), (280.3, 398.1), (268.9, 410.65), (275.25, 400.75), (275.5, 401.5), (240.0, 460.0)]


@pytest.mark.parametrize(("cx", "cy"), CENTERS)
@pytest.mark.parametrize("window_of", [inside, around])
def test_projections_stay_where_they_were(cx, cy, window_of):
    original = camera(cx, cy)
    window = window_of(original)
    centre = np.array([window.camera.width, window.camera.height]) / 2
    assert np.array_equal(window.camera.K[:2, 2], centre)
    grid, points = points_on(original)
    moved = project(window.camera, points) + [window.left, window.top]
    assert np.abs(moved - grid).max() < 0.02
    assert np.allclose(window.camera.center, original.center)


@pytest.mark.parametrize(("cx", "cy"), CENTERS)
def test_windows_are_the_largest_inside_and_least_around(cx, cy):
    original = camera(cx, cy)
    image = np.random.default_rng(0).integers(0, 256, (802, 550, 3), dtype=np.uint8)
    small, large = inside(original), around(original)
    for size, name, center in ((550, "width", cx), (802, "height", cy)):
        off = round(abs(size - 2 * center))
        assert abs(getattr(small.camera, name) - (size - off)) <= 1
        assert abs(getattr(large.camera, name) - (size + off)) <= 1
    assert small.cut(image).shape[:2] == (small.camera.height, small.camera.width)
    padded = np.zeros((large.camera.height, large.camera.width, 3), np.uint8)
    padded[-large.top : 802 - large.top, -large.left : 550 - large.left] = image
    assert np.array_equal(large.uncut(padded, original), image)


NAME = "ga"


@pytest.fixture
def heads(repository):
    """The toy head and the same with teeth, as the stand-in wants them."""
    return [(head, OfficialHead.of(head, repository[0])) for head in (toy_head(16), with_teeth(toy_head(16)))]


def test_lips_get_their_numbers_and_faces_stay(heads):
    for head, theirs in heads:
        assert len(theirs.order) > theirs.order.max() + 1, "vertices that stand for nothing fill the gaps"
        kept = theirs.order[theirs.order >= 0]
        teeth = head.regions.get("teeth", [])
        assert sorted(kept) == sorted(set(range(len(head.template))) - {*map(int, teeth)})
        plain = head.faces[~np.isin(head.faces, teeth).any(axis=1)]
        assert np.array_equal(theirs.order[theirs.faces], plain)
        count = len(lip_rings(head)[0])
        first = len(toy_head(16).template) + 5
        for ring, start in zip(lip_rings(head), (first, first + 1)):
            assert np.array_equal(theirs.order[start : start + 2 * count : 2], ring)


def test_values_of_vertices_that_stand_for_nothing_are_zero(heads):
    for head, theirs in heads:
        values = theirs.vertices(head.template)
        assert np.array_equal(values[theirs.order >= 0], head.template[theirs.order[theirs.order >= 0]])
        assert not values[theirs.order < 0].any()


def test_a_head_of_their_topology_keeps_its_numbers(repository, tmp_path):
    head = toy_head(16)
    OfficialHead.of(head, repository[0]).write(tmp_path)
    own = OfficialHead(head, np.arange(len(head.template)), head.faces)
    own.write(repository[0])  # as if the checkout's template were this head
    assert (repository[0] / TEMPLATE_FILE).is_file()
    found = OfficialHead.of(with_teeth(head), repository[0])
    assert np.array_equal(found.order, np.arange(len(head.template)))
    assert np.array_equal(found.faces, head.faces)


def test_parameters_are_padded_and_eyelids_left_out(official_clip, repository):
    head = official_clip.head
    theirs = OfficialHead.of(head, repository[0])
    offset = np.random.default_rng(0).standard_normal(head.template.shape)
    tracking = OfficialTracking(theirs, np.asarray(official_clip.shape), offset)
    found = tracking.parameters(official_clip.poses[0])
    assert set(found) == {
        *("translation", "rotation", "neck_pose", "jaw_pose", "eyes_pose", "expr", "shape", "static_offset")
    }
    assert found["shape"].shape == (300,)
    assert found["expr"].shape == (1, 100)
    assert np.array_equal(found["expr"][0, :8], official_clip.poses[0].expression)
    assert not found["expr"][0, 8:].any()
    assert np.array_equal(
        found["static_offset"][0][theirs.order >= 0], offset[theirs.order[theirs.order >= 0]].astype("f4")
    )
    assert {array.dtype for array in found.values()} == {np.dtype("float32")}


READ = """
import sys
from pickle import load
with open(sys.argv[1], "rb") as stream:
    found = load(stream, encoding="latin1")
assert "numpy.core" not in sys.modules and found["a"].flags.writeable
print({name: (str(array.dtype), array.tolist()) for name, array in found.items()})
"""


def test_arrays_are_pickled_without_a_module_that_moved(tmp_path):
    arrays = {
        "a": np.arange(6, dtype=np.uint32).reshape(2, 3),
        "b": np.array([0.5]),
        "c": np.arange(4.0)[::2],
    }
    content = pickled(arrays)
    assert b"multiarray" not in content
    write_bytes(tmp_path / "head.pkl", content)
    lines: list[str] = []
    command = [sys.executable, "-c", READ, str(tmp_path / "head.pkl")]
    assert run_program(command, tmp_path, tmp_path / "log", lines.append).code == 0
    assert lines[-1] == str({name: (str(array.dtype), array.tolist()) for name, array in arrays.items()})


def test_a_sparse_matrix_is_named_by_its_public_module():
    dense = np.random.default_rng(0).standard_normal((5, 7)) * (np.arange(7) % 2)
    content = pickled({"J_regressor": SparseMatrix(dense)})
    assert b"_csc" not in content
    assert b"numpy._core" not in content
    assert b"multiarray" not in content
    found = pickle.loads(content)["J_regressor"]
    assert isinstance(found, scipy.sparse.csc_matrix)
    assert np.array_equal(found.todense(), dense)


def test_marks_of_neighbours_are_told_apart():
    marks = np.array([mark(number) for number in range(4096)]).astype(int)
    assert len(np.unique(marks, axis=0)) == 4096
    assert np.abs(np.diff(marks, axis=0)).max(axis=1).min() >= MARK_STEP
    assert marks.min() >= MARK_STEP // 2
    assert marks.max() <= 255 - MARK_STEP // 2 + 1
