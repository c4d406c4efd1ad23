from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from headbench.datasets.head.model import HeadModel
from headbench.datasets.synthetic.anatomy import linear
from headbench.datasets.synthetic.hair import STYLES
from headbench.datasets.synthetic.history import over_time
from headbench.datasets.synthetic.plan import FRONTAL, SERIALS, cameras, draw_person
from headbench.datasets.synthetic.skin import FLUSHES, FOLDS
from headbench.datasets.synthetic.subject import RenderedSubject

from .conftest import settled


@pytest.mark.parametrize("seed", [0, 7, 14])
def test_ten_subjects_are_of_all_kinds(seed):
    people = [draw_person(str(index), index, seed) for index in range(10)]
    assert {who.style for who in people} == set(STYLES)
    assert {"", "metal", "plastic"} == {who.glasses for who in people}
    assert 2 <= sum(who.beard > 0 for who in people) <= 6
    assert {who.beard > 0.01 for who in people if who.beard} == {True, False}
    tones = sorted(float(who.skin.mean()) for who in people)
    assert tones[0] < 1.5 * linear("#6a4430").mean() < 0.7 * linear("#e2b49a").mean() < tones[-1]
    assert min(who.sag for who in people) == 0.0
    assert max(who.sag for who in people) > 0.7
    assert all(
        0.0 < value < 1.0 for who in people for color in (who.skin, who.hair, who.lips) for value in color
    )


@pytest.fixture(scope="module")
def bearded(plan):
    """A subject with beard and glasses, without the sagging skin of age."""
    changes = {"beard": 0.015, "glasses": "plastic", "sag": 0.0, "skin": 0.5 * plan.person.skin}
    return replace(plan, person=replace(plan.person, **changes))


@pytest.fixture(scope="module")
def dressed(bearded):
    return RenderedSubject(bearded.person, bearded.geometry, bearded.shape)


def test_people_look_different_on_the_same_head(subject, dressed):
    dark, light = (each.rest_meshes()["skin"].albedo[:, 0].mean() for each in (dressed, subject))
    assert dark < 0.75 * light


def folds(states):
    return np.array([state.folds for state in states])


def ramp(rest, control, values, **others):
    return [{**rest, **others, control: value} for value in values]


def test_folds_buckle_and_stay_so_on_the_way_back(bearded, rest):
    who = replace(bearded.person, lines_at_rest=0.0)
    values = np.linspace(0.0, 1.0, 101)
    up_and_down = ramp(rest, "brow_inner_up", [*values, *values[::-1]])
    depth = folds(over_time(up_and_down, 0.04, who))[:, FOLDS.index("forehead_mid")]
    up, down = depth[:101], depth[101:][::-1]
    jumps = np.flatnonzero(np.diff(up) > 0.1), np.flatnonzero(np.diff(down) > 0.1)
    assert [len(each) for each in jumps] == [1, 1]
    assert 0.30 <= values[jumps[0][0] + 1] <= 0.56
    assert 0.11 <= values[jumps[0][0]] - values[jumps[1][0]] <= 0.26
    away = np.ones(101, bool)
    away[jumps[1][0] : jumps[0][0] + 2] = False
    np.testing.assert_array_equal(up[away], down[away])


def test_blood_comes_late_and_pressed_skin_fills_again(bearded, rest):
    smile = {**rest, "smile_left": 1.0, "smile_right": 1.0, "lip_press": 1.0}
    states = over_time([smile] * 10 + [rest] * 10, 0.5, bearded.person)
    flushes = np.array([state.flushes for state in states])
    cheeks, lips = (flushes[:, list(FLUSHES).index(name)] for name in ("cheeks", "lips_pale"))
    np.testing.assert_allclose(cheeks[[0, 9]], 1.0 - np.exp([-0.5 / 0.9, -5.0 / 0.9]), atol=1e-4)
    np.testing.assert_allclose(cheeks[10:] / cheeks[9], np.exp(-0.2 * np.arange(1, 11)), atol=1e-4)
    assert lips[0] == lips[9]
    assert lips[10] / lips[9] == pytest.approx(np.exp(-0.5 / 0.8), abs=1e-4)
    wet = [state.wet for state in over_time([{**rest, "lip_roll": 1.0}, rest, rest], 2.0, bearded.person)]
    np.testing.assert_allclose(wet, np.exp([0.0, -0.5, -1.0]), atol=1e-5)


def test_the_tracked_mesh_has_hair_volume_and_not_locks(bearded):
    head, offset = bearded.geometry.head, bearded.writer.plan.static_offset
    model = HeadModel(head, dtype=torch.float64)
    plain = model.canonical(torch.from_numpy(bearded.shape))
    joints = np.asarray(head.joint_regressor, np.float64) @ offset
    assert np.abs(joints).max() < 1e-7
    eyes = np.concatenate([head.regions["left_eyeball"], head.regions["right_eyeball"]])
    assert np.linalg.norm(offset[eyes], axis=1).max() < 1e-6
    top = plain[0, :, 1].numpy().argmax()
    style = STYLES[bearded.person.style]
    assert 0.5 * style.cap < offset[top, 1] < style.cap + style.rise
    edges = head.faces[:, :2]
    assert np.linalg.norm(offset[edges[:, 0]] - offset[edges[:, 1]], axis=1).max() < 0.5 * style.cap + 0.002


def test_beard_and_glasses_lie_on_the_face_and_move_with_it(bearded, dressed, rest):
    assert {"beard", "glasses"} <= dressed.rest_meshes().keys()
    pose = bearded.geometry.translation.pose(rest, "900", 0)
    calm = dressed.posed_meshes(pose, rest, settled(rest, bearded.person))
    skin = calm["skin"].vertices
    assert cKDTree(skin).query(calm["beard"].vertices)[0].max() < 0.025
    assert 0.001 < cKDTree(skin).query(calm["glasses"].vertices)[0].max() < 0.04
    mouth, ear = dressed.anatomy["mouth"], dressed.anatomy["left_ear"]
    assert calm["beard"].vertices[:, 1].max() > ear[1] - 0.01
    middle = np.abs(calm["beard"].vertices - mouth)[:, :2] < np.array([0.012, 0.002])
    assert middle.all(axis=1).mean() < 0.002  # hardly any hair lies over the lips
    opened = {**rest, "jaw_open": 1.0}
    pose = bearded.geometry.translation.pose(opened, "900", 0)
    moved = dressed.posed_meshes(pose, opened, settled(opened, bearded.person))
    fall = calm["beard"].vertices[:, 1] - moved["beard"].vertices[:, 1]
    assert np.percentile(fall, 90) > 0.01
    np.testing.assert_array_equal(moved["glasses"].vertices, calm["glasses"].vertices)


TARGET = np.array([0.01, 0.02, 0.03])


@pytest.mark.parametrize("count", [1, 2, 3, 8, 15, 16])
def test_every_set_has_the_frontal_camera_in_canonical_order(count):
    made = list(cameras(count, 100, 146, TARGET))
    assert len(made) == count
    assert FRONTAL in made
    assert made == [serial for serial in SERIALS if serial in made]


def test_arc_spans_93_by_32_degrees_and_all_look_at_the_head():
    azimuth, elevation = [], []
    for camera in cameras(16, 550, 802, TARGET).values():
        x, y, z = camera.center - TARGET
        azimuth.append(np.degrees(np.arctan2(x, z)))
        elevation.append(np.degrees(np.arctan2(y, np.hypot(x, z))))
        rotation = camera.world_to_camera[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=3e-9)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        seen = camera.K @ (rotation @ TARGET + camera.world_to_camera[:3, 3])
        np.testing.assert_allclose(seen[:2] / seen[2], camera.K[:2, 2], atol=1e-5)
        assert (rotation @ [0.0, 1.0, 0.0])[1] < 0  # up in the world is up in the image
    assert np.ptp(azimuth) == pytest.approx(93.0, abs=4)
    assert np.ptp(elevation) == pytest.approx(32.0, abs=1)
    assert len(np.unique(np.round(azimuth, 3))) >= 15
