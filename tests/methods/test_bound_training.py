"""The scene's extent, and what every clip is checked for."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.contracts import Camera
from headbench.bench.errors import InputError
from headbench.methods.bound_training import scene_extent
from headbench.methods.clip_checks import check_training_split


def camera_at(*center):
    world_to_camera = np.eye(4)
    world_to_camera[:3, 3] = -np.array(center)
    return Camera("x", 4, 4, np.eye(3), world_to_camera)


def test_extent_is_the_largest_distance_from_the_mean_centre():
    cameras = {str(i): camera_at(*c) for i, c in enumerate([(0, 0, 0), (4, 0, 0), (2, 3, 0)])}
    mean = np.array([2, 1, 0])
    expected = 1.1 * max(np.linalg.norm(np.array(c) - mean) for c in [(0, 0, 0), (4, 0, 0), (2, 3, 0)])
    assert scene_extent(cameras) == pytest.approx(expected)


def test_a_single_camera_still_has_an_extent():
    assert scene_extent({"a": camera_at(0, 0, 2)}) == pytest.approx(1.1)
    assert scene_extent({"a": camera_at(0, 0, 0)}) > 0


def test_a_sound_clip_passes(clip):
    check_training_split(clip)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: {"splits": {}}, "at least one frame"),
        (lambda c: {"poses": {}}, "tracked pose"),
        (lambda c: {"cameras": {}}, "known camera"),
        (
            lambda c: {"poses": {t: replace(p, head_model="other") for t, p in c.poses.items()}},
            "head_model",
        ),
    ],
)
def test_an_unsound_clip_is_refused(clip, change, says):
    with pytest.raises(InputError, match=says):
        check_training_split(replace(clip, **change(clip)))
