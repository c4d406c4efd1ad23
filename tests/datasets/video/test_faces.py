"""Whose face is followed where a video shows several people, or nobody for a while."""

import numpy as np
import pytest

from headbench.bench.io.videos import TimedFrame
from headbench.bench.landmark_network import COUNT, CROP, FaceCrop, face_size, same_face
from headbench.datasets.video import faces
from headbench.datasets.video.faces import ANCHORS, SIDE, FaceDetector, FaceFinder, find_faces

SHAPE = np.random.default_rng(0).uniform(-0.5, 0.5, (COUNT, 2))
BLACK = np.zeros((4, 4, 3), np.uint8)


def face(x, size=40.0):
    return np.array([x, 100.0]) + size * SHAPE


class Network:
    """A network that sees the faces of each frame; the number of a frame is in its first pixel."""

    def __init__(self, shown):
        self.shown, self.searched = shown, []

    def follow(self, image, near):
        near_by = [one for one in self.shown[image[0, 0, 0]] if same_face(one, near)]
        return near_by[0] if near_by else None

    def find_all(self, image):
        self.searched.append(int(image[0, 0, 0]))
        return sorted(self.shown[image[0, 0, 0]], key=face_size, reverse=True)


def frames(count):
    for number in range(count):
        yield TimedFrame(2 * number, number / 5, np.full((4, 4, 3), number, np.uint8))


def found(tmp_path, shown, network=None):
    return find_faces("me.mp4", frames(len(shown)), network or Network(shown), tmp_path / "faces.npz", "mark")


STILL = [[face(50)] for _ in range(12)]
CASES = {
    "one": (STILL, [50] * 12, [0] * 12),
    "leaves and comes back elsewhere": (
        [[face(50)]] * 5 + [[]] * 3 + [[face(200)]] * 4,
        [50] * 5 + [None] * 3 + [200] * 4,
        [0] * 12,
    ),
    "jumps to a place that is near": ([[face(50)]] * 5 + [[face(88)]] * 7, [50] * 5 + [88] * 7, [0] * 12),
    "another one appears elsewhere after it has left": (
        [[face(50)]] * 7 + [[]] + [[face(200)]] * 4,
        [50] * 7 + [None] * 5,
        [0] * 8 + [1] * 4,
    ),
    "another one enters between two searches, then it leaves": (
        [[face(50)]] * 3 + [[face(50), face(200)]] * 4 + [[face(200)]] * 5,
        [50] * 7 + [None] * 5,
        [0] * 7 + [1] * 5,
    ),
    "another one enters and is seen at the next search": (
        [[face(50)]] * 3 + [[face(50), face(200)]] * 9,
        [50] * 12,
        [0] * 10 + [1] * 2,
    ),
    "a larger second face": ([[face(50), face(200, 30 + 3 * t)] for t in range(8)], [50] * 8, [1] * 8),
    "the other one stays": (
        [[face(50, 44), face(200)]] * 3 + [[face(200)]] * 3 + [[face(60, 44), face(200)]] * 2,
        [50] * 3 + [None] * 3 + [60] * 2,
        [1] * 8,
    ),
    "the other one moves to the place of the first": (
        [[face(50), face(122 - 6 * t, 39)] for t in range(8)] + [[face(68 - 6 * t, 39)] for t in range(4)],
        [50] * 8 + [None] * 4,
        [1] * 12,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_one_person_is_followed(tmp_path, name):
    shown, places, others = CASES[name]
    result = found(tmp_path, shown)
    assert result.found.tolist() == [place is not None for place in places]
    middles = result.pixels[result.found].mean(axis=1)[:, 0] - 40 * SHAPE.mean(axis=0)[0]
    np.testing.assert_allclose(middles, [place for place in places if place is not None], atol=1)
    assert result.others.tolist() == others
    assert result.numbers.tolist() == [2 * number for number in range(len(shown))]


@pytest.mark.parametrize(
    ("name", "searched", "again"),
    [
        ("one", [0, 10], []),
        ("leaves and comes back elsewhere", [0, 5, 6, 7, 8, 10], [(16, 150 / 40, True)]),
        ("the other one stays", [0, 3, 4, 5, 6], [(12, 10 / 44, False)]),
        ("jumps to a place that is near", [0, 5, 10], [(10, 38 / 40, True)]),
    ],
)
def test_a_lost_face_is_searched_and_its_jump_is_known(tmp_path, name, searched, again):
    shown = CASES[name][0]
    network = Network(shown)
    result = found(tmp_path, shown, network)
    assert network.searched == searched
    assert [(one.number, one.elsewhere) for one in result.again] == [(one[0], one[2]) for one in again]
    assert [one.jump for one in result.again] == pytest.approx([one[1] for one in again], rel=0.02)


def test_an_interrupted_search_gives_the_same_landmarks(tmp_path):
    shown = CASES["the other one stays"][0]
    whole = found(tmp_path / "whole", shown)
    assert whole.pixels.dtype == np.float32

    def broken():
        yield from frames(5)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        find_faces("me.mp4", broken(), Network(shown), tmp_path / "faces.npz", "mark")
    network = Network([None] * 5 + shown[5:])  # which fails at frames that were searched
    again = find_faces("me.mp4", frames(8), network, tmp_path / "faces.npz", "mark")
    for one, other in zip(whole, again):
        np.testing.assert_array_equal(one, other)
    find_faces("me.mp4", iter([None]), network, tmp_path / "faces.npz", "mark")  # reads no frame


def test_landmarks_are_stored_meanwhile_for_a_kill(tmp_path, monkeypatch):
    monkeypatch.setattr(faces, "STORED_S", 0.0)
    stored = []
    monkeypatch.setattr(faces, "store_arrays", lambda path, mark, arrays: stored.append(arrays))
    found(tmp_path, STILL)
    assert [len(one["numbers"]) for one in stored] == [*range(1, 13), 12]
    assert [bool(one["finished"]) for one in stored] == [False] * 12 + [True]


FACE, SEEN = (255, 255, 255), (SIDE / 15, SIDE / 1.8)
"""Colour of a face, and the sides that the network sees."""


class DetectorFile:
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
    found._network, found._input, found._boxes, found._scores = DetectorFile(), "image", "boxes", "scores"
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
