"""Refined masks and colours without the room, on synthetic heads with exact masks before a room of many colours."""

import cv2
import numpy as np
import pytest

from headbench.datasets.synthetic.plan import SyntheticSettings, load_geometry, plan_subject
from headbench.datasets.synthetic.renderer import CaptureRenderer
from headbench.datasets.video.matting import refined_mask, without_room

SIDE, CELL = 144, 3


@pytest.fixture(scope="module")
def heads(tmp_path_factory):
    """Frames before a room, exact coverage, images on white and coarse masks, of two cameras."""
    rng = np.random.default_rng(0)
    settings = SyntheticSettings(1, 2, 8, (SIDE, SIDE), "procedural", 0, 0.0, 9)
    plan = plan_subject(tmp_path_factory.mktemp("plan"), 0, load_geometry("procedural"), settings)
    renderer = CaptureRenderer(plan)
    renderer.pose_at("FREE", 0)
    room = np.full((SIDE, SIDE, 3), (0.1, 0.8, 0.2), np.float32)
    for x, y in rng.integers(0, SIDE, (40, 2)):
        room[y : y + rng.integers(8, 40), x : x + rng.integers(8, 24)] = rng.uniform(0, 1, 3)
    room = cv2.GaussianBlur(room, (0, 0), 4)  # out of focus
    found = []
    for camera in plan.cameras:
        white, coverage = (np.float32(levels) / 255 for levels in renderer.render(camera, 0))
        shown = white - (1 - coverage[..., None]) * (1 - room)
        frame = np.rint(255 * shown.clip(0, 1)).astype(np.uint8)
        cells = cv2.resize(coverage, (SIDE // CELL, SIDE // CELL), interpolation=cv2.INTER_AREA)
        coarse = (255 * cv2.resize(cells, (SIDE, SIDE))).astype(np.uint8)
        found.append((frame, coverage, white, coarse))
    return found


FACE = np.array([[SIDE / 2, SIDE / 2]])


def errors(frame, mask, coverage, white):
    """Mean absolute error of coverage, and of colour on white, near the outline."""
    edge = ((coverage > 0.02) & (coverage < 0.98)).astype(np.uint8)
    band = cv2.dilate(edge, np.ones((2 * CELL + 1, 2 * CELL + 1))) > 0
    share = mask[..., None] / np.float32(255)
    shown = share * (frame / np.float32(255)) + 1 - share
    return np.abs(share[..., 0] - coverage)[band].mean(), np.abs(shown - white)[band].mean()


def test_a_refined_mask_is_closer_to_the_exact_one(heads):
    before, after = [], []
    for frame, coverage, white, coarse in heads:
        mask = refined_mask(frame, coarse, FACE)
        assert (mask.shape, mask.dtype) == (coverage.shape, np.uint8)
        before.append(errors(frame, coarse, coverage, white))
        after.append(errors(without_room(frame, mask), mask, coverage, white))
    assert (np.mean(after, axis=0) < np.array([0.8, 0.65]) * np.mean(before, axis=0)).all()


def test_colours_of_an_exact_mask_lose_the_room(heads):
    before, after = [], []
    for frame, coverage, white, _ in heads:
        mask = np.rint(255 * coverage).astype(np.uint8)
        cleaned = without_room(frame, mask)
        assert np.array_equal(cleaned[mask == 255], frame[mask == 255])
        before.append(errors(frame, mask, coverage, white)[1])
        after.append(errors(cleaned, mask, coverage, white)[1])
    assert np.mean(after) < 0.7 * np.mean(before)


def test_only_the_part_with_the_face_is_kept(heads):
    frame, _, _, coarse = heads[0]
    other = coarse.copy()
    other[:12, :100] = 255  # larger areas than the face's are no reason
    other[12:40, :6] = 255
    assert not refined_mask(frame, other, FACE)[:8, :80].any()
    kept = refined_mask(frame, other, np.array([[2.0, 30.0], [-5.0, 20.0]]))
    assert kept[:8, :80].all()
    assert not kept[SIDE // 2, SIDE // 2]


def test_frames_of_one_part_are_not_changed():
    image = np.random.default_rng(0).integers(0, 256, (20, 30, 3)).astype(np.uint8)
    for level in (0, 255):
        mask = np.full((20, 30), level, np.uint8)
        assert np.array_equal(refined_mask(image, mask, np.array([[5.0, 5.0]])), mask)
        assert np.array_equal(without_room(image, mask), image)


def disk():
    """A frame of two flat colours with a disk, its exact mask, and the distance of pixels from its middle; its radius is 30."""
    side = 96
    place = np.stack(np.meshgrid(np.arange(side) + 0.5, np.arange(side) + 0.5), axis=2)
    distance = np.linalg.norm(place - [50.2, 44.9], axis=2)
    coverage = np.clip(30.5 - distance, 0, 1)[..., None]
    frame = np.rint(coverage * [200, 40, 30] + (1 - coverage) * [20, 60, 210]).astype(np.uint8)
    return frame, np.rint(255 * coverage[..., 0]).astype(np.uint8), distance


@pytest.mark.parametrize(("level", "radius"), [(230, 6), (100, 3)])
def test_a_highlight_of_the_colour_of_the_room_is_kept(level, radius):
    frame, mask, distance = disk()
    spot = distance < radius
    frame[spot] = 20, 60, 210
    mask[spot] = level
    refined = refined_mask(frame, mask, np.array([[50.0, 30.0]]))
    assert refined[spot].min() > 250
    assert np.array_equal(without_room(frame, refined)[spot], frame[spot])


def test_a_hole_that_the_mask_is_sure_of_is_kept():
    frame, mask, distance = disk()
    hole = distance < 10
    frame[hole] = 20, 60, 210
    mask[hole] = 0
    refined = refined_mask(frame, cv2.GaussianBlur(mask, (0, 0), 1.0), np.array([[50.0, 30.0]]))
    assert refined[distance < 8].max() < 5
    assert refined[(distance > 12) & (distance < 26)].min() > 250


def test_two_flat_colours_determine_the_coverage():
    frame, exact, distance = disk()
    coarse = cv2.GaussianBlur(exact, (0, 0), 2.0)
    before, after = (
        np.abs(mask.astype(float) - exact)[np.abs(distance - 30) < 3].mean()
        for mask in (coarse, refined_mask(frame, coarse, np.array([[50.0, 45.0]])))
    )
    assert after < 0.1 * before
