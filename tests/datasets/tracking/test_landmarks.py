"""Landmarks on a head model, learnt from pictures in which their places are known."""

import numpy as np
import pytest

from headbench.bench.landmark_network import COUNT
from headbench.datasets.head.procedural.model import procedural_head
from headbench.datasets.tracking.landmarks import (
    AZIMUTHS,
    ELEVATIONS,
    drawn_head,
    learn_embedding,
    spread_vertices,
)

from ..tiny_capture import projected


@pytest.fixture(scope="module")
def head():
    return procedural_head("2023")


@pytest.fixture(scope="module")
def pictures(head):
    return [*drawn_head(head)]


def face_vertices(head, count):
    face = np.asarray(head.regions["face"])
    return face[spread_vertices(np.asarray(head.template)[face], count)]


class Network:
    """Finds vertices of the drawn head, moved in the picture by ``error`` pixels."""

    def __init__(self, pictures, vertices, error=0.0):
        self.vertices, self.error, self.rng = vertices, error, np.random.default_rng(0)
        self.known = {picture.image.tobytes(): picture for picture in pictures}

    def find(self, image, near=None):
        _, camera, mesh = self.known[image.tobytes()]
        pixels = projected(mesh[self.vertices], camera)
        return pixels + self.error * self.rng.normal(size=pixels.shape)


def test_the_head_is_drawn_whole_from_all_directions(head, pictures):
    assert len(pictures) == len(AZIMUTHS) * len(ELEVATIONS)
    for image, camera, mesh in pictures:
        pixels = projected(mesh[head.regions["face"]], camera)
        assert (pixels > 0).all()
        assert (pixels < [camera.width, camera.height]).all()
        assert image.shape == (camera.height, camera.width, 3)


@pytest.mark.parametrize(("error", "most"), [(0.0, 2e-4), (0.5, 1e-3)])
def test_landmarks_are_found_where_they_are(head, pictures, error, most):
    vertices = np.resize(face_vertices(head, 117), COUNT)
    found = learn_embedding(Network(pictures, vertices, error), head, pictures)
    assert len(found.landmarks) > 0.5 * COUNT
    template = np.asarray(head.template)
    places = np.einsum("lk,lki->li", found.weights, template[found.corners])
    distance = np.linalg.norm(places - template[vertices[found.landmarks]], axis=1)
    assert np.median(distance) < most
