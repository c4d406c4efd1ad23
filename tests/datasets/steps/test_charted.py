"""The chart made for heads without one: every triangle in its own cell, in the same scale and sheared."""

import numpy as np

from headbench.bench.engine.config import RunConfig
from headbench.datasets.steps.rest import packed_chart, with_packed_chart

CONFIG = RunConfig(data="", out="")


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
