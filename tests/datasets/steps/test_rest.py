"""Expressions that are not zero at rest: the same posed meshes from another mesh at zero."""

import numpy as np
import pytest

from headbench.bench.engine.config import RunConfig
from headbench.bench.errors import InputError
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.steps.rest import packed_chart, with_packed_chart, with_rest_expression

CONFIG = RunConfig(data="", out="")


def test_posed_meshes_are_equal_and_the_mesh_at_zero_is_not(clip):
    changed = with_rest_expression(clip, CONFIG, millimetres=2.0)
    poses = [*clip.poses.values()]
    before, after = PosedSubject.of(clip), PosedSubject.of(changed)
    assert np.abs(after.meshes([*changed.poses.values()]) - before.meshes(poses)).max() < 1e-6
    face = np.unique(clip.head.faces[np.isin(clip.head.faces, clip.head.regions["face"]).all(1)])
    moved = np.linalg.norm(changed.static_offset - clip.static_offset, axis=1)[face]
    assert np.median(moved) == pytest.approx(2e-3, rel=1e-3)
    assert changed.fingerprint != clip.fingerprint
    assert changed.image(next(iter(changed.files))) is not None


def test_a_distance_that_is_none_is_refused(clip):
    with pytest.raises(InputError, match="millimetres: expected a number above 0, found 0"):
        with_rest_expression(clip, CONFIG, millimetres=0)


def area(corners):
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * np.sqrt((one**2).sum(1) * (other**2).sum(1) - (one * other).sum(1) ** 2)


def test_triangles_keep_areas_and_have_their_own_cells(clip):
    vertices, faces = clip.head.template, clip.head.faces
    uv = packed_chart(vertices, faces).astype(np.float64)
    assert uv.shape == (len(faces), 3, 2)
    assert 0 <= uv.min() < uv.max() <= 1
    ratio = area(uv) / area(vertices[faces])
    np.testing.assert_allclose(ratio, ratio.mean(), rtol=1e-2)
    cells = np.floor(uv * np.ceil(np.sqrt(len(faces)))).astype(int)
    assert (cells == cells[:, :1]).all()
    assert len(np.unique(cells[:, 0], axis=0)) == len(faces)


def test_the_two_directions_are_18_degrees_from_orthogonal():
    corners = np.random.default_rng(0).normal(size=(3, 3))
    place = packed_chart(corners, np.array([[0, 1, 2]])).astype(np.float64)[0]
    edges, of_chart = corners[1:] - corners[0], place[1:] - place[0]
    tangent, bitangent = np.linalg.solve(of_chart, edges)
    lengths = np.linalg.norm([tangent, bitangent], axis=1)
    assert abs(abs(np.degrees(np.arcsin(tangent @ bitangent / lengths.prod()))) - 18) < 1e-3
    assert abs(lengths[1] / lengths[0] * np.cos(np.radians(18)) - 1) < 1e-5  # nothing but sheared


def test_a_clip_gets_a_chart_once(clip):
    charted = with_packed_chart(clip, CONFIG)
    assert charted.head.uv.shape == (len(clip.head.faces), 3, 2)
    assert charted.fingerprint != clip.fingerprint
    assert with_packed_chart(charted, CONFIG) is charted
