"""The parts of the picture: cameras on their side, outlines on silhouettes, choices of what to show."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.bench.io.figures import pixels
from headbench.datasets.figures import HELD_OUT, TRAIN, hexadecimal, new_figure
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.inspect.command import NUMBERS, PICTURE, InspectSettings, inspect
from headbench.datasets.inspect.figure import (
    draw_rig,
    head_frame,
    overlay,
    pick_cameras,
    pick_timesteps,
)
from headbench.datasets.inspect.statistics import expression_space

from ..lint.good_capture import FRONTAL, read_rgb
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


def test_the_head_frame_undoes_a_rigid_motion(clip):
    template = clip.head.template
    angle = 0.7
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    moved = template @ turn.T + [0.3, -0.2, 0.1]
    frame = head_frame(moved, template, np.arange(len(template)))
    back = moved @ frame[:3, :3].T + frame[:3, 3]
    assert back == pytest.approx(template - template.mean(axis=0), abs=1e-12)


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
