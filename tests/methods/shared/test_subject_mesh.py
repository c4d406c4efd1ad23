"""One subject's mesh against the head model it is built on; the mask of the mouth; and the bounded cache."""

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

from headbench.bench.errors import InputError
from headbench.datasets.head.model import HeadModel
from headbench.methods.shared.avatar_files import clip_mesh
from headbench.methods.shared.surface_points import BoundedCache, SubjectMesh, mouth_mask

from ..toy_clip import first_view, look_at


def test_posed_vertices_are_the_head_models(clip, head):
    offset = np.random.default_rng(0).normal(scale=0.001, size=head.template.shape)
    mesh = SubjectMesh(head, clip.shape, offset, "cpu")
    model = HeadModel(head, dtype=torch.float64)
    expected = model(
        shape=torch.from_numpy(clip.shape),
        static_offset=torch.from_numpy(offset),
        **model.pose_arguments([clip.poses[1]]),
    )[0]
    np.testing.assert_allclose(mesh.posed(mesh.arguments([clip.poses[1]])), expected, atol=1e-6)


def test_unposed_drops_rotation_neck_and_translation_only(clip, head):
    mesh = SubjectMesh(head, clip.shape, clip.static_offset, "cpu")
    arguments = mesh.arguments([clip.poses[0]])
    found = mesh.unposed(arguments)
    for name in ("rotation", "neck", "translation"):
        changed = {**arguments, name: arguments[name] + 0.3}
        np.testing.assert_array_equal(mesh.unposed(changed), found)
    for name in ("expression", "jaw", "eyes"):
        changed = {**arguments, name: arguments[name] + 0.3}
        assert (mesh.unposed(changed) - found).abs().max() > 1e-5


def test_a_neutral_pose_is_canonical(clip, head):
    mesh = SubjectMesh(head, clip.shape, clip.static_offset, "cpu")
    neutral = {name: torch.zeros_like(v) for name, v in mesh.arguments([clip.poses[0]]).items()}
    np.testing.assert_allclose(mesh.posed(neutral), mesh.canonical, atol=1e-7)


def test_the_mask_is_the_outline_of_the_lips(clip):
    camera, pose = first_view(clip)
    camera, mesh = camera.resized(280, 360), clip_mesh(clip, "cpu")
    vertices = mesh.posed(mesh.arguments([pose])).numpy()
    lips, middle = vertices[clip.head.regions["lips"]], vertices.mean(0)
    mask = mouth_mask(camera, lips, middle)
    projected = (camera.K @ (camera.world_to_camera @ np.c_[lips, np.ones(len(lips))].T)[:3]).T
    hull = ConvexHull(projected[:, :2] / projected[:, 2:]).equations
    pixels = np.stack(np.meshgrid(np.arange(280) + 0.5, np.arange(360) + 0.5), axis=-1)
    outside = (pixels @ hull[:, :2].T + hull[:, 2]).max(-1)
    assert mask[outside < -1].all()
    assert not mask[outside > 1].any()
    assert (outside < -1).sum() > 200
    behind = look_at(np.array([0.0, 0.0, -0.5]), np.zeros(3), "behind", 280, 360)
    assert not mouth_mask(behind, lips, middle).any()


def test_the_cache_computes_once_and_stays_bounded():
    computed = []

    def square(key):
        computed.append(key)
        return key * key

    cache = BoundedCache(square, 2)
    assert [cache(k) for k in (1, 2, 1, 3, 1, 2)] == [1, 4, 1, 9, 1, 4]
    assert computed == [1, 2, 3, 2]  # 2 was the least recently used when 3 came
    assert len(cache) == 2


def test_an_identity_that_makes_no_head_is_refused(clip, head):
    with pytest.raises(InputError, match="a head within 10 m"):
        SubjectMesh(head, np.full_like(clip.shape, 9e3), clip.static_offset, "cpu")
