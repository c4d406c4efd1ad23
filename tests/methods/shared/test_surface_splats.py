"""Axes at points on the mesh of a subject."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from headbench.methods.shared.avatar_files import clip_mesh
from headbench.methods.shared.surface_points import poisson_disk
from headbench.methods.shared.surface_splats import HeadSurface


def test_axes_follow_the_neck_where_the_surface_does(clip):
    mesh = clip_mesh(clip, "cpu")
    faces, vertices = clip.head.faces, mesh.canonical.numpy()
    surface = HeadSurface(mesh, poisson_disk(vertices, faces, np.arange(len(faces)), 400, 0))
    pose = replace(clip.poses[0], rotation=np.array([0.1, 0.4, 0.0]), neck=np.array([0.5, 0.0, -0.2]))
    found = Rotation.from_matrix(surface.posed(mesh.arguments([pose])).rotation.numpy())
    share = surface._of_root[:, 0].numpy()
    root, neck = Rotation.from_rotvec(pose.rotation), Rotation.from_rotvec(pose.neck)
    for end, part in ((root, 1 - share), (root * neck, share)):
        np.testing.assert_allclose((end.inv() * found).magnitude(), part * neck.magnitude(), atol=0.005)
    assert share.max() > 0.5
    assert share.min() == 0


def test_a_neck_beyond_half_a_turn_has_axes_of_the_shorter_turn(clip):
    mesh = clip_mesh(clip, "cpu")
    faces, vertices = clip.head.faces, mesh.canonical.numpy()
    surface = HeadSurface(mesh, poisson_disk(vertices, faces, np.arange(len(faces)), 400, 0))
    neck = np.array([0.5, 0.0, -0.2])
    longer = neck * (1 - 2 * np.pi / np.linalg.norm(neck))
    found, expected = (
        surface.posed(mesh.arguments([replace(clip.poses[0], neck=each)])).rotation for each in (longer, neck)
    )
    np.testing.assert_allclose(found, expected, atol=1e-4)
