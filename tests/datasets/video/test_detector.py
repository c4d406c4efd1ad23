"""Faces of any size in frames of any shape, with a network that sees bright squares."""

import numpy as np
import pytest

from headbench.bench.landmark_network import COUNT, CROP, FaceCrop
from headbench.datasets.video.faces import ANCHORS, SIDE, FaceDetector, FaceFinder

FACE, SEEN = (255, 255, 255), (SIDE / 15, SIDE / 1.8)
"""Colour of a face, and the sides that the network sees."""


class Network:
    """In place of the detector's file: logits and boxes of the bright part of the square."""

    def set_tensor(self, index, value):
        assert value.shape == (1, SIDE, SIDE, 3)
        self.bright = np.argwhere(value[0, ..., 0] > 0)[:, ::-1]

    def invoke(self):
        self.logits, self.boxes = np.full((1, len(ANCHORS), 1), -9.0), np.zeros((1, len(ANCHORS), 16))
        if not len(self.bright):
            return
        low, high = self.bright.min(axis=0), self.bright.max(axis=0) + 1
        if SEEN[0] < (high - low).max() < SEEN[1] and low.min() > 0 and high.max() < SIDE:
            middle = (low + high) / 2
            near = np.argsort(np.abs(ANCHORS - middle).max(axis=1))[:2]  # two cells see it
            self.logits[0, near] = 3.0
            points = [middle - ANCHORS[near], np.tile(high - low, (2, 1))]
            points += [middle + eye - ANCHORS[near] for eye in ([-4, -2], [4, 2])]
            self.boxes[0, near, :8] = np.concatenate(points, axis=1)

    def get_tensor(self, index):
        return self.logits if index == "scores" else self.boxes


@pytest.fixture
def detector():
    found = object.__new__(FaceDetector)
    found._network, found._input, found._boxes, found._scores = Network(), "image", "boxes", "scores"
    return found


@pytest.mark.parametrize(
    ("width", "height", "box"),
    [
        (256, 256, (10, 8, 246, 244)),  # fills the picture
        (1920, 1080, (900, 200, 1100, 400)),
        (1080, 1920, (100, 1300, 400, 1600)),
        (3840, 2160, (3000, 1700, 3200, 1900)),
        (64, 48, (20, 10, 44, 34)),
    ],
)
def test_one_face_is_found_once(detector, width, height, box):
    image = np.zeros((height, width, 3), np.uint8)
    image[box[1] : box[3], box[0] : box[2]] = FACE
    (crop,) = detector.detect(image)
    side = box[2] - box[0]
    np.testing.assert_allclose(crop.middle, np.array([box[:2], box[2:]]).mean(axis=0), atol=0.05 * side)
    assert crop.side == pytest.approx(CROP * side, rel=0.15)
    assert crop.angle == pytest.approx(np.arctan2(4, 8))


def test_faces_are_confirmed_by_landmarks():
    shape = np.random.default_rng(0).uniform(-0.5, 0.5, (COUNT, 2))
    crops = [
        FaceCrop(np.array([x, 100.0]), CROP * side, 0.0)
        for x, side in ((140, 80), (530, 160), (720, 60), (560, 30))
    ]

    class Networks:
        """The third crop has no face, the fourth is a part of the second face."""

        def detect(self, image):
            return crops

        def find_in(self, image, crop):
            return None if crop is crops[2] else crop.middle + crop.side / CROP * shape

    finder = object.__new__(FaceFinder)
    finder.detector = finder.network = Networks()
    found = finder.find_all(np.zeros((4, 4, 3), np.uint8))
    np.testing.assert_allclose([one.mean(axis=0)[0] for one in found], [530, 140], atol=8)
