"""The parts of the picture: cameras on their side, outlines on silhouettes, choices of what to show."""

import json
from collections import Counter
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from headbench.bench.errors import InputError
from headbench.bench.io.documents import read_json
from headbench.bench.io.figures import pixels
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.model import PosedSubject, frontal_key
from headbench.datasets.inspect.command import (
    NUMBERS,
    PICTURE,
    InspectSettings,
    StepsSettings,
    inspect,
    steps,
)
from headbench.datasets.inspect.figure import (
    HELD_OUT,
    TRAIN,
    draw_rig,
    head_frame,
    hexadecimal,
    new_figure,
    overlay,
    pick_cameras,
    pick_timesteps,
)
from headbench.datasets.inspect.statistics import expression_space
from headbench.datasets.steps.figures import (
    find_jaw_bases,
)

from ..lint.good_capture import FRONTAL, read_rgb
from ..steps.clips import make_clip, with_poses
from ..tiny_capture import look_at


@pytest.mark.commands
def test_picture_numbers_and_text(capture, clip, tmp_path):
    calls = []
    settings = InspectSettings(str(capture.union), out=str(tmp_path / "out"), timesteps=1, cameras=2)
    findings = inspect(settings, lambda *arguments: calls.append(arguments))
    assert findings.passed
    assert calls
    picture = read_rgb(tmp_path / "out" / PICTURE)
    assert picture.shape[1] == 1600
    numbers = json.loads((tmp_path / "out" / NUMBERS).read_text())
    assert numbers["fingerprint"] == clip.fingerprint
    counts = {row["split"]: row["images"] for row in numbers["splits"]}
    assert counts == {"train": 36, "novel_view": 12, "self_reenactment": 40}
    held_out = [camera for camera in numbers["cameras"] if camera["held_out"]]
    assert [camera["id"] for camera in held_out] == ["222200037"]
    assert held_out[0]["principal_point_off_centre_px"] == pytest.approx([0.4, -0.6])
    assert held_out[0]["position_m"] == pytest.approx(clip.cameras["222200037"].center)
    assert "novel_view" in findings.text
    assert "FREE" in findings.text
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [NUMBERS, PICTURE]


@pytest.mark.parametrize("changes", [{"timesteps": 0}, {"cameras": 0}, {"clip": "nothing"}])
def test_what_cannot_be_shown_is_refused_before_any_writing(capture, tmp_path, changes):
    settings = {"clip": str(capture.union), "out": str(tmp_path / "out")} | changes
    with pytest.raises(InputError):
        inspect(InspectSettings(**settings))
    assert not (tmp_path / "out").exists()


def near(picture: np.ndarray, colour: str) -> np.ndarray:
    """(N, 2) x, y of pixels of about a colour."""
    return np.argwhere(np.abs(picture.astype(int) - hexadecimal(colour)).max(axis=2) < 40)[:, ::-1]


@pytest.fixture(scope="module")
def head(clip):
    vertices = clip.head.template
    face = clip.head.regions["face"]
    return vertices, clip.head.faces, head_frame(vertices, clip.head.template, face)


@pytest.mark.parametrize("above", [True, False])
def test_cameras_stand_on_their_side_of_the_head(head, above):
    """One before the head and to its left and above, held out; one before it, lower."""
    cameras = {
        "front": look_at("front", np.array([0.0, -0.1, 1.0]), 60, 80, 30, 40),
        "aside": look_at("aside", np.array([0.8, 0.5, 0.6]), 60, 80, 30, 40),
    }
    with new_figure(4, 4) as figure:
        axes = figure.subplots()
        draw_rig(axes, cameras, {"aside"}, *head, from_above=above)
        axes.axis("off")
        picture = pixels(figure)
    front, aside = near(picture, TRAIN).mean(axis=0), near(picture, HELD_OUT).mean(axis=0)
    grey = (
        (np.ptp(picture.astype(int), axis=2) < 12) & (picture.max(axis=2) < 215) & (picture.min(axis=2) > 60)
    )
    rows, columns = np.nonzero(cv2.erode(grey.astype(np.uint8), np.ones((7, 7), np.uint8)))
    middle = np.array([columns.mean(), rows.mean()])
    if above:  # the subject's left is the page's right, its front the page's foot
        assert front[1] > middle[1] + 50
        assert abs(front[0] - middle[0]) < 25
        assert aside[0] > front[0] + 50
    else:  # the front is the page's right, up is up
        assert front[0] > middle[0] + 50
        assert aside[1] < front[1] - 50


def test_the_outline_lies_on_the_silhouette(clip):
    key = clip.splits["train"][0]
    camera, height = clip.cameras[key.camera], 320
    vertices = PosedSubject.of(clip).meshes([clip.poses[key.timestep]])[0]
    outlined, covered = overlay(clip.image(key), vertices, clip.head.faces, camera, height)
    assert outlined.shape == covered.shape == (height, 240, 3)
    drawn = near(outlined, HELD_OUT)
    mask = cv2.resize(clip.mask(key), (240, height), interpolation=cv2.INTER_LINEAR) > 127
    edge = mask & ~cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    distance = cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, 5)
    assert np.percentile(distance[drawn[:, 1], drawn[:, 0]], 95) < 4  # one image pixel is four here
    assert len(drawn) > 200
    inside = cv2.erode(mask.astype(np.uint8), np.ones((15, 15), np.uint8)).astype(bool)
    assert np.ptp(covered[inside].astype(int), axis=1).mean() < 45  # clay over skin


def test_held_out_cameras_come_first(clip):
    assert pick_cameras(clip, 3) == [FRONTAL, "222200042", "222200049"]
    assert pick_cameras(clip, 1) == [FRONTAL]
    assert sorted(pick_cameras(clip, 99)) == sorted(clip.cameras)
    without = replace(clip, splits={**clip.splits, "novel_view": ()})
    assert pick_cameras(without, 2) == ["222200042", "222200049"]


def test_timesteps_are_distinct_and_told_why(clip):
    space = expression_space(clip)
    for count in (1, 3, 6):
        chosen = pick_timesteps(clip, space, count)
        assert len({timestep for timestep, _ in chosen}) == len(chosen) == count
    reasons = {reason: timestep for timestep, reason in pick_timesteps(clip, space, 3)}
    assert reasons["widest jaw"] == max(clip.poses, key=lambda t: np.linalg.norm(clip.poses[t].jaw))
    assert reasons["calmest face"] == min(clip.poses, key=lambda t: np.linalg.norm(clip.poses[t].expression))


def turn_between(one, other):
    """Angle between two axis-angle rotations, degrees."""
    return np.degrees((Rotation.from_rotvec(one).inv() * Rotation.from_rotvec(other)).magnitude())


def test_jaw_numbers_are_those_of_brute_force():
    clip = make_clip(30, test=5)
    found = find_jaw_bases(clip, 6)
    jaws = np.array([clip.poses[t].jaw for t in range(30)])
    gaps = np.array([[turn_between(jaw, np.radians(base)) for base in found.angles] for jaw in jaws])
    assert np.isclose(found.largest_gap, gaps.min(axis=1).max(), atol=1e-6)
    nearest = Counter(gaps.argmin(axis=1).tolist())
    np.testing.assert_allclose(found.shares, [nearest[i] / 30 for i in range(6)])
    np.testing.assert_allclose(np.radians(found.train), jaws, atol=1e-12)
    assert len(found.held_out) == 5
    assert found.record()["leaks"] == []
    published = find_jaw_bases(make_clip(10, test=20), 5, variant="official")
    assert "held-out" in published.record()["leaks"][0]
    assert np.abs(published.angles[0]).max() == pytest.approx(180)


def test_the_medoids_camera_is_the_one_the_face_looks_at(clip):
    timestep = clip.timesteps("train")[0]
    cameras = {key.camera for key in clip.splits["train"] if key.timestep == timestep}
    assert len(cameras) > 1
    for name in cameras:
        towards = clip.cameras[name].center / np.linalg.norm(clip.cameras[name].center)
        turn, _ = Rotation.align_vectors([towards], [[0.0, 0.0, 1.0]])
        looking = with_poses(
            clip, rotation=lambda t, turn=turn: turn.as_rotvec(), translation=lambda t: np.zeros(3)
        )
        assert frontal_key(looking, timestep).camera == name


@pytest.mark.commands
@pytest.mark.parametrize("variant", ["paper", "official"])
def test_command_writes_pictures_and_numbers(pristine_capture, tmp_path, variant):
    settings = StepsSettings(str(pristine_capture.union), str(tmp_path), clusters=2, variant=variant)
    with pytest.raises(InputError, match="--clusters"):
        steps(replace(settings, clusters=0))
    assert not list(tmp_path.iterdir())
    findings = steps(settings)
    clip = read_capture(pristine_capture.union)
    stored = read_json(tmp_path / "steps.json")
    assert stored["clip"] == clip.fingerprint
    assert stored["jaw_bases"]["leaks"] == list(findings.data["jaw_bases"]["leaks"])
    assert bool(stored["jaw_bases"]["leaks"]) == (variant == "official") == ("Leak" in findings.text)
    assert sum(stored["expression_clusters"]["class_sizes"]) == len(clip.timesteps("train"))
    for name in ("jaw_bases.png", "expression_clusters.png"):
        picture = cv2.imread(str(tmp_path / name))
        assert picture is not None
        assert picture.std() > 10
