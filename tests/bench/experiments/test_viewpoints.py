"""The turntable: closed forms on a rig whose geometry is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from headbench.bench.contracts import Camera
from headbench.bench.errors import InputError
from headbench.bench.experiments.viewpoints import common_target, look_at, turntable

CENTER = np.array([0.1, 1.5, -0.2])
UP = np.array([0.0, 1.0, 0.0])


def camera(azimuth, elevation=0.0, distance=1.0, name="", up=UP):
    a, e = np.radians([azimuth, elevation])
    direction = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    K = np.array([[300.0, 0, 40], [0, 300, 70], [0, 0, 1]])
    return Camera(name, 100, 140, K, look_at(CENTER + distance * direction, CENTER, up))


def azimuth_of(view):
    x, _, z = view.camera.center - CENTER
    return np.degrees(np.arctan2(x, z))


def test_looking_at_a_point_puts_it_on_the_axis_and_up_upwards():
    motion = look_at(np.array([1.0, 2.0, 3.0]), CENTER, UP)
    assert np.allclose(motion[:3, :3] @ motion[:3, :3].T, np.eye(3))
    assert np.linalg.det(motion[:3, :3]) > 0
    x, y, z = (motion @ [*CENTER, 1.0])[:3]
    assert np.allclose([x, y], 0)
    assert np.isclose(z, np.linalg.norm(CENTER - [1, 2, 3]))
    above = motion @ [*(CENTER + 0.1 * UP), 1.0]
    assert above[1] < 0
    assert np.isclose(above[0], 0)


def test_views_step_evenly_beyond_both_ends():
    rig = [camera(a) for a in (40, -60, 0, 80)]
    views = turntable(rig, CENTER, 11, 30.0)
    assert np.allclose([azimuth_of(v) for v in views], np.linspace(-90, 110, 11))
    assert [v.extrapolated for v in views] == [not -60 <= a <= 80 for a in np.linspace(-90, 110, 11)]
    assert all(np.isclose(np.linalg.norm(v.camera.center - CENTER), 1.0) for v in views)


def test_a_view_at_a_training_camera_is_that_camera():
    rig = [camera(-20, 10, 1.0), camera(0, -5, 1.4), camera(30, 20, 0.8)]
    start, *_, end = turntable(rig, CENTER, 5, 0.0)
    assert np.allclose(start.camera.center, rig[0].center)
    assert np.allclose(end.camera.center, rig[2].center)
    second = turntable(rig, CENTER, 6, 0.0)[2]  # 0.4 of the way from -20 to 30 is 0
    assert np.allclose(second.camera.center, rig[1].center)
    assert np.allclose(np.diag(second.camera.K), [300, 300, 1])


def test_between_two_cameras_the_way_is_the_great_circle():
    low, high = camera(-30, 0), camera(30, 50)
    middle = turntable([low, high], CENTER, 3, 0.0)[1].camera.center - CENTER
    bisector = (low.center + high.center) / 2 - CENTER
    assert np.allclose(middle, bisector / np.linalg.norm(bisector))


def test_beyond_the_ends_elevation_and_distance_stay():
    first = turntable([camera(-10, 25, 1.3), camera(10, 0)], CENTER, 5, 40.0)[0]
    offset = first.camera.center - CENTER
    assert np.isclose(np.linalg.norm(offset), 1.3)
    assert np.isclose(np.degrees(np.arcsin(offset[1] / 1.3)), 25)
    assert np.isclose(azimuth_of(first), -50)
    assert first.extrapolated


@pytest.mark.parametrize(
    ("rig", "count", "beyond", "azimuths", "extrapolated"),
    [
        (range(-150, 200, 50), 8, 30.0, np.arange(8) * 45 + 30, [False] * 8),  # all around: closed
        ((150, 180, -150), 3, 0.0, [150, 180, 210], [False] * 3),  # across the back
        ((15,), 3, 20.0, [-5, 15, 35], [True, False, True]),
    ],
)
def test_rigs_all_around_behind_and_of_one_camera(rig, count, beyond, azimuths, extrapolated):
    views = turntable([camera(a) for a in rig], CENTER, count, beyond)
    found = np.array([azimuth_of(v) for v in views])
    np.testing.assert_allclose(np.sort(found % 360), np.sort(np.mod(azimuths, 360)), atol=1e-4)
    assert [v.extrapolated for v in views] == extrapolated


@given(
    st.lists(st.tuples(st.floats(-180, 180), st.floats(-60, 60)), min_size=1, max_size=20),
    st.integers(1, 20),
    st.floats(0, 170),
)
def test_every_view_is_a_rigid_camera_that_sees_the_head(angles, count, beyond):
    rig = [camera(a, e) for a, e in angles]
    views = turntable(rig, CENTER, count, beyond)
    assert len(views) == count
    for view in views:
        rotation = view.camera.world_to_camera[:3, :3]
        assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        x, y, w = view.camera.K @ (view.camera.world_to_camera @ [*CENTER, 1.0])[:3]
        assert w > 0.5
        assert np.allclose([x / w, y / w], [50, 70], atol=1e-6)


def test_a_camera_in_the_head_is_refused():
    camera = Camera("", 4, 4, np.eye(3), look_at(CENTER, CENTER + UP, np.eye(3)[0]))
    with pytest.raises(InputError):
        turntable([camera], CENTER, 4, 0.0)


def test_the_common_target_is_where_the_cameras_look():
    head = CENTER + [0.0, -0.1, -0.1]
    for azimuths, expected in (
        ([-40, 0, 40], CENTER),  # where the axes meet
        ([0], CENTER - [0.0, 0.0, 0.1]),  # the point of the axis that is nearest to the head's centre
    ):
        assert np.allclose(common_target([camera(a) for a in azimuths], head), expected, atol=1e-3)
