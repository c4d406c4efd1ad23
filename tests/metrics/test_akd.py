"""Distance of facial landmarks, and frames in which no face is found."""

import numpy as np
import pytest

from headbench.bench.engine.scoring import score_frames
from headbench.bench.errors import LeftOutError
from headbench.bench.landmark_network import COUNT
from headbench.bench.rows import LEFT_OUT, Rows
from headbench.metrics import akd
from headbench.reports.aggregate import subject_means, summarise, whole_images

from ..bench.engine.test_scoring import FRAMES, KEYS
from ..reports.made_rows import row


class Network:
    """Finds landmarks at (level, level) of the first pixel; none in black pictures."""

    def __init__(self):
        self.near = []

    def find(self, image, near=None):
        self.near.append(near)
        return np.full((COUNT, 2), float(image[0, 0, 0])) if image.any() else None


@pytest.fixture
def network(monkeypatch):
    found = Network()
    monkeypatch.setattr(akd.AkdMediaPipe, "network", lambda self: found)
    return found


def level(value):
    return np.full((40, 30, 3), value, np.uint8)


def test_the_distance_is_that_of_the_landmarks(network):
    assert akd.AkdMediaPipe()(level(13), level(10)) == pytest.approx(3 * np.sqrt(2))
    assert network.near[0] is None
    np.testing.assert_array_equal(network.near[1], np.full((COUNT, 2), 10.0))


@pytest.mark.parametrize(("image", "truth", "name"), [(0, 9, "render"), (9, 0, "ground truth")])
def test_a_picture_without_a_face_is_left_out(network, image, truth, name):
    with pytest.raises(LeftOutError, match=f"no face is found in the {name}"):
        akd.AkdMediaPipe()(level(image), level(truth))


def test_frames_left_out_have_a_reason(network, monkeypatch):
    monkeypatch.setattr("headbench.bench.engine.scoring.resolve", lambda name: akd.AkdMediaPipe)
    scores = score_frames(KEYS, FRAMES, [akd.AKD_MEDIAPIPE])["akd-mediapipe"]
    assert [score.status for score in scores] == ["missing", "ok", "ok", "ok"]  # the first truth is black
    assert scores[0].reason == f"{LEFT_OUT}no face is found in the ground truth"


def test_means_are_over_the_others_and_say_how_many_are_left_out():
    reason = f"{LEFT_OUT}no face is found in the render"
    lost = {"status": "missing", "reason": reason}
    given = [row("a", "akd", 2.0), row("a", "akd", 4.0, timestep=1)]
    rows = Rows.of([*given, row("a", "akd", float("nan"), timestep=2, **lost)])
    found = summarise(rows, "a", "akd", "novel_view")
    assert (found.status, found.value) == ("ok", 3.0)
    assert found.reason == f"Without 1 of 3 frames, {reason}."
    assert subject_means(whole_images(rows, "a", "akd", "novel_view")) == {"s": 3.0}
    alone = Rows.of([row("a", "akd", float("nan"), **lost)])
    assert summarise(alone, "a", "akd", "novel_view").status == "missing"
