"""The start of "ours": which splats lie where before training."""

import numpy as np
import pytest
import torch

from headbench.datasets.head.arrays import faces_in_region
from headbench.methods.ours.appearance import expressive_triangles, outer_layers_start
from headbench.methods.ours.spec import Lines, OursConfig, OuterLayers, Penalty
from headbench.methods.shared.surface_points import SubjectMesh


@pytest.fixture
def mesh(clip):
    return SubjectMesh(clip.head, clip.shape, clip.static_offset, "cpu")


def test_the_published_start_is_one_splat_at_each_centroid(clip, mesh):
    for config in (OursConfig(), OursConfig(outer_layers=OuterLayers(count=2), lines=Lines(enabled=False))):
        start = outer_layers_start(mesh, clip, config, "cpu")
        np.testing.assert_array_equal(start.binding, np.arange(len(mesh.faces)))
        assert not start.means.any()


def test_outer_layers_lie_a_gap_apart_along_the_normal(clip, mesh):
    config = OursConfig(
        outer_layers=OuterLayers(count=2, gap=0.002, opacity=0.2), penalty=Penalty(face_mm=0.01)
    )
    start = outer_layers_start(mesh, clip, config, "cpu")
    frames, count = mesh.frames(mesh.canonical), len(mesh.faces)
    more = len(start.binding) - count
    assert more > 0
    assert more % 2 == 0
    b = start.binding[count:]
    world = torch.einsum("nij,nj->ni", frames.rotation[b], start.means[count:] * frames.size[b, None])
    corners = mesh.canonical[mesh.faces[b]]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = normal / torch.linalg.vector_norm(normal, dim=1, keepdim=True)
    expected = 0.002 * torch.tensor([1.0, 2.0]).repeat_interleave(more // 2)
    np.testing.assert_allclose(world, normal * expected[:, None], atol=1e-7)
    np.testing.assert_array_equal(start.opacities[count:], np.float32(0.2))


def test_face_triangles_that_expressions_move_are_expressive(clip, mesh):
    face = faces_in_region(clip.head, "face")
    timesteps = {key.timestep for key in clip.splits["train"]}
    moved = np.zeros(len(face))
    for t in timesteps:  # independent: vertex means in numpy
        unposed = mesh.unposed(mesh.arguments([clip.poses[t]])).numpy()
        d = (unposed - mesh.canonical.numpy())[mesh.faces.numpy()[face]].mean(1)
        moved = np.maximum(moved, np.linalg.norm(d, axis=1))
    threshold = float(np.median(moved)) + 1e-9
    found = expressive_triangles(mesh, clip, 1000 * threshold, "cpu")
    np.testing.assert_array_equal(found, face[moved >= threshold])
    assert 0 < len(found) < len(face)


def test_a_static_face_has_no_outer_layers(clip, mesh):
    assert len(expressive_triangles(mesh, clip, 1e6, "cpu")) == 0
    start = outer_layers_start(
        mesh, clip, OursConfig(outer_layers=OuterLayers(count=1), penalty=Penalty(face_mm=1e6)), "cpu"
    )
    assert len(start.binding) == len(mesh.faces)
