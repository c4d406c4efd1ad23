"""Projection and visibility against the camera's definition and a rasterised mesh."""

import numpy as np

from headbench.datasets.mesh_pictures import rasterize_mesh
from headbench.datasets.tracking.rig import Occlusion, Views

from ..head.toy import toy_head
from ..tiny_capture import projected, rig


def test_projection_and_its_derivative():
    cameras, rng = rig(), np.random.default_rng(0)
    views, points = Views(cameras), 0.1 * rng.standard_normal((5, 3))
    found = views.project(points)
    for row, camera in enumerate(cameras):
        wanted = projected(points, camera)
        np.testing.assert_allclose(found.pixels[row], wanted, atol=1e-9)
        np.testing.assert_allclose(views.place(points)[0][row], wanted, atol=1e-3)
    step = 1e-6
    for axis in range(3):
        moved = views.project(points + step * np.eye(3)[axis]).pixels
        np.testing.assert_allclose(
            (moved - found.pixels) / step, found.derivative[..., axis], rtol=1e-3, atol=1e-2
        )
    one = views.project(points[:3], np.array([2, 0, 1]))
    np.testing.assert_allclose(one.pixels, found.pixels[[2, 0, 1], [0, 1, 2]])
    np.testing.assert_allclose(one.derivative, found.derivative[[2, 0, 1], [0, 1, 2]])


def test_visible_vertices_are_those_in_front():
    head = toy_head(24)
    mesh = np.asarray(head.template, np.float64)
    cameras = rig(240, 320, 123.0, 147.0)
    cosine = Occlusion(head, mesh, Views(cameras)).visible(mesh, np.arange(len(mesh)))
    for camera, found in zip(cameras, cosine):
        front = rasterize_mesh(mesh, head.faces, camera)
        shown = np.zeros(len(mesh), bool)
        shown[head.faces[front.face[front.face >= 0]]] = True  # a corner of a triangle that is drawn
        assert shown[found > 0.3].mean() > 0.95
        assert (found[~shown] > 0.3).mean() < 0.05
        assert (found > 0).sum() > 50


def test_a_wall_hides_a_vertex():
    head = toy_head(16)
    mesh = np.asarray(head.template, np.float64).copy()
    views = Views(rig()[1:2])
    skin = np.array([int(mesh[:, 2].argmax())])
    assert Occlusion(head, mesh, views).visible(mesh, skin)[0, 0] > 0
    eye = np.asarray(head.regions["left_eyeball"])
    mesh[eye] += mesh[skin] + [0, 0, 0.05] - mesh[eye].mean(axis=0)  # the eyeball before the nose
    assert Occlusion(head, mesh, views).visible(mesh, skin)[0, 0] == 0
