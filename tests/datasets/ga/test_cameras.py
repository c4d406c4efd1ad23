"""Telling where cy counts from, on heads with hair and shoulders and with imperfect tracking."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from headbench.bench.contracts import Camera
from headbench.datasets.ga.cameras import CyEvidence, OutlineView, weigh_cy

from ..head.toy import toy_head
from ..tiny_capture import look_at, projected, silhouette

HEAD = toy_head(24)
WIDTH, HEIGHT = 138, 200


def ellipsoid_hull(camera: Camera, center, radii) -> np.ndarray:
    """(H, W) bool outline-filled projection of an ellipsoid, by the hull of points on it."""
    points = np.random.default_rng(1).normal(size=(300, 3))
    points = points / np.linalg.norm(points, axis=1, keepdims=True) * radii + center
    pixels = projected(points, camera)
    filled = np.zeros((camera.height, camera.width), np.uint8)
    cv2.fillConvexPoly(filled, cv2.convexHull(np.round(pixels).astype(np.int32)), 1)
    return filled > 0


def make_views(offset: float, noise: float, *, seed: int = 0) -> list[OutlineView]:
    """Eight cameras around a head with hair and shoulders; ``noise`` in metres displaces the tracked mesh."""
    rng = np.random.default_rng(seed)
    views = []
    for number, angle in enumerate(np.radians(np.linspace(-46, 46, 8))):
        position = np.array([np.sin(angle), 0.25 * (-1) ** number, np.cos(angle)])
        camera = look_at(str(number), position, WIDTH, HEIGHT, WIDTH / 2 + 1, HEIGHT / 2 + offset)
        mask = silhouette(HEAD.template, HEAD.faces, camera)
        mask |= ellipsoid_hull(camera, [0, 0.05, -0.03], [0.1, 0.1, 0.11])
        mask |= ellipsoid_hull(camera, [0, -0.22, -0.05], [0.22, 0.09, 0.1])
        tracked = (
            HEAD.template + noise * rng.normal(size=3) + 0.3 * noise * rng.normal(size=HEAD.template.shape)
        )
        image = (mask * 255).astype(np.uint8)
        views.append(OutlineView(tracked, camera, lambda image=image: image))
    return views


def flipped(view: OutlineView) -> OutlineView:
    """The view of a reader that takes a cy from the bottom for one from the top."""
    K = view.camera.K.copy()
    K[1, 2] = HEIGHT - K[1, 2]
    camera = view.camera
    return OutlineView(view.vertices, Camera(camera.id, WIDTH, HEIGHT, K, camera.world_to_camera), view.mask)


@pytest.mark.parametrize("offset", [-6.0, 2.0])
def test_outlines_decide_in_spite_of_hair_shoulders_and_noise(offset):
    """Evidence of the two readings swaps with the reading."""
    views = make_views(offset, 0.001)
    one, other = weigh_cy(views, HEAD.faces), weigh_cy([flipped(view) for view in views], HEAD.faces)
    assert (one.decision, other.decision) == ("top", "bottom")
    assert (one.top, one.bottom) == pytest.approx((other.bottom, other.top), abs=1e-9)


def test_exact_mesh_alone_agrees_wholly():
    views = [
        replace(view, mask=lambda v=view: np.uint8(255 * silhouette(v.vertices, HEAD.faces, v.camera)))
        for view in make_views(5.0, 0.0)
    ]
    evidence = weigh_cy(views, HEAD.faces)
    assert evidence.top > 0.7  # OpenCV fills every pixel touched, which moves outlines by half a pixel
    assert evidence.bottom < 0.5 * evidence.top


def test_image_border_is_no_outline():
    """A mesh that fills the lower half of the image, cut by three borders, agrees along one line only."""
    camera = Camera("c", 40, 40, np.array([[40.0, 0, 20], [0, 40, 20], [0, 0, 1]]), np.eye(4))
    corners = np.array([[-9, 0.0125, 1], [9, 0.0125, 1], [9, 9, 1], [-9, 9, 1]])  # top edge at y = 20.5
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    mask = np.zeros((40, 40), np.uint8)
    mask[20:] = 255
    assert weigh_cy([OutlineView(corners, camera, lambda: mask)], faces).top == 1
    mask_without_edge = np.full((40, 40), 255, np.uint8)
    assert weigh_cy([OutlineView(corners, camera, lambda: mask_without_edge)], faces).top == 0


@pytest.mark.parametrize(
    ("evidence", "decision"),
    [
        (CyEvidence(0.5, 0.3, 1.0), "top"),
        (CyEvidence(0.3, 0.5, 0.0), "bottom"),
        (CyEvidence(0.5, 0.3, 0.6), None),  # frames disagree
        (CyEvidence(0.3, 0.5, 0.4), None),
        (CyEvidence(0.5, 0.49, 1.0), None),  # hardly a difference
        (CyEvidence(0.0, 0.0, 0.5), None),
    ],
)
def test_decision_needs_a_margin_and_a_majority(evidence, decision):
    assert evidence.decision == decision
