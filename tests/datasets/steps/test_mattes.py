"""Masks on frames whose true colours are known, and the line below the neck against a filled half-plane."""

from dataclasses import asdict, replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from headbench.bench.contracts import Camera
from headbench.bench.errors import InputError
from headbench.bench.manifest import cut_of
from headbench.bench.specs import ResolutionRule
from headbench.datasets.clip import FrameFiles
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.images import ImageStore, write_image
from headbench.datasets.steps.for_method import align_clip
from headbench.datasets.steps.masks import (
    NeckLine,
    composite,
    mask_below_neck,
    neck_anchors,
    neck_line,
    recomposite,
    set_background,
    without_torso,
)

from ..tiny_capture import projected

SIZE = 64
WHITE, BLUE = (1.0, 1.0, 1.0), (0.0, 0.2, 0.9)


def subject(size=SIZE):
    """Smooth colours and a soft-edged disc: (foreground, coverage), float32."""
    y, x = np.mgrid[:size, :size] / size
    colours = np.stack([0.6 + 0.2 * np.sin(7 * x), 0.4 + 0.2 * y, 0.3 + 0.1 * x * y], axis=-1)
    coverage = np.clip((0.32 - np.hypot(x - 0.5, y - 0.5)) / 0.08 + 0.5, 0, 1)
    return colours.astype(np.float32), coverage.astype(np.float32)


def rounded(image):
    return np.round(image * 255).astype(np.uint8)


# ------------------------------------------------------------------ arithmetic


@settings(max_examples=50, deadline=None)
@given(*[st.tuples(*[st.floats(0, 1)] * 3)] * 2)
def test_exchanging_equals_compositing_on_the_new_background(old, new):
    colours, coverage = subject(24)
    expected = coverage[5, 6] * colours[5, 6] + (1 - coverage[5, 6]) * np.array(old)
    assert np.abs(composite(colours, coverage, old)[5, 6] - expected).max() < 1e-6
    exchanged = recomposite(composite(colours, coverage, old), coverage, old, new)
    assert np.abs(exchanged - composite(colours, coverage, new)).max() < 1e-5


def test_a_background_that_was_not_quite_so_cannot_shine_through():
    coverage = np.zeros((4, 4), np.float32)
    nearly_white = np.full((4, 4, 3), 0.97, np.float32)
    assert (recomposite(nearly_white, coverage, WHITE, (0.0, 0.0, 0.0)) == 0).all()


# ------------------------------------------------------------------ clips


def with_pixels(clip, folder, image, mask):
    """A clip whose frames all show one image (3 or 4 channels) with one mask."""
    path, mask_path = folder / "image.png", folder / "mask.png"
    order = [2, 1, 0, 3][: image.shape[2]]
    cv2.imwrite(str(path), image[..., order])
    if mask is not None:
        cv2.imwrite(str(mask_path), mask)
    files = {key: FrameFiles(path, path if mask is None else mask_path) for key in clip.files}
    height, width = image.shape[:2]
    cameras = {name: camera.resized(width, height) for name, camera in clip.cameras.items()}
    return replace(clip, files=files, cameras=cameras, store=ImageStore())


def test_a_clip_on_another_background(clip, tmp_path):
    colours, coverage = subject()
    levels = rounded(coverage)
    shown = levels.astype(np.float32) / 255
    opaque = with_pixels(clip, tmp_path, rounded(composite(colours, shown, WHITE)), levels)
    key = clip.splits["train"][0]
    changed = set_background(opaque, BLUE)
    expected = 255 * composite(colours, shown, BLUE)
    assert np.abs(changed.image(key) - expected).max() <= 1.01  # one rounding on file, one here
    assert np.array_equal(changed.mask(key), levels)
    assert changed.background == pytest.approx(BLUE)
    assert changed.fingerprint != opaque.fingerprint
    again = set_background(changed, WHITE)
    assert np.abs(again.image(key).astype(int) - opaque.image(key)).max() <= 1
    assert [step.name for step in again.steps[-2:]] == ["set_background", "set_background"]


def test_straight_colours_on_file_are_rounded_once(clip, tmp_path):
    colours, coverage = subject()
    rgba = np.dstack([rounded(colours), rounded(coverage)])
    straight = with_pixels(clip, tmp_path, rgba, None)
    changed = set_background(straight, BLUE)
    assert changed.pixel_steps == ()
    assert set_background(straight, WHITE) is straight
    key = clip.splits["train"][0]
    expected = 255 * composite(rgba[..., :3] / 255, rgba[..., 3] / 255, np.array(BLUE))
    assert np.abs(changed.image(key) - expected).max() <= 0.5 + 1e-3
    # After another step they are composited on what they were read on.
    rule = ResolutionRule(divide=2)
    found = set_background(align_clip(straight, rule), BLUE).image(key).astype(int)
    assert np.abs(found - align_clip(changed, rule).image(key)).max() <= 1


def test_what_a_mask_step_needs_is_said(clip):
    faceless = replace(clip, head=replace(clip.head, regions={"face": np.arange(3)}))
    with pytest.raises(InputError, match="a region 'boundary' or 'neck'"):
        mask_below_neck(faceless)


# ------------------------------------------------------------------ below the neck


def test_the_edge_is_a_half_plane_blurred_by_a_gaussian():
    line = NeckLine((31.3, 40.2), (0.196116, -0.980581))
    y, x = np.mgrid[: 64 * 8, : 64 * 8] / 8 + 1 / 16
    hard = ((x - 31.3) * 0.196116 - (y - 40.2) * 0.980581 > 0).astype(float)
    soft = gaussian_filter(hard, 3.0 * 8, mode="nearest")[4::8, 4::8]
    found = line.weights(64, 64, 3.0)
    inner = np.s_[10:-10, 10:-10]
    assert np.abs(found - soft)[inner].max() < 0.01
    assert found[5, 30] > 0.999
    assert found[60, 30] < 0.001


UPRIGHT = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]])
ROLLED = np.diag([-1.0, -1, 1, 1]) @ UPRIGHT
SIDE = np.array([[0.0, 0, -1, 0], [0, -1, 0, 0], [-1, 0, 0, 1], [0, 0, 0, 1]])


@pytest.mark.parametrize(("view", "normal"), [(UPRIGHT, (0, -1)), (ROLLED, (0, 1)), (SIDE, (0, -1))])
def test_the_neck_line_follows_the_head_in_every_view(view, normal):
    anchors = np.array([[0.0, -0.1, 0.08], [0.06, -0.1, 0.0], [-0.06, -0.1, 0.0], [0.0, 0.12, 0.08]])
    camera = Camera("c", 100, 100, np.array([[500.0, 0, 50], [0, 500, 50], [0, 0, 1]]), view)
    assert neck_line(camera, anchors).normal == pytest.approx(normal, abs=1e-9)
    assert neck_line(camera, anchors - 9 * view[2, :3]) is None  # behind the camera


def test_images_and_masks_end_below_the_line_through_the_neck(clip, tmp_path):
    noise = np.random.default_rng(0).integers(0, 200, (64, 48, 3)).astype(np.uint8)
    clip = with_pixels(clip, tmp_path, noise, np.full((64, 48), 255, np.uint8))
    cut = mask_below_neck(clip)
    posed, anchors = PosedSubject.of(clip), neck_anchors(clip.head)
    changed, tilts = 0, set()
    for key in clip.splits["train"]:
        camera, pose = clip.cameras[key.camera], clip.poses[key.timestep]
        vertices = posed.meshes([pose])[0, anchors]
        front, left, right, _ = projected(vertices, camera)
        y, x = np.mgrid[:64, :48] + 0.5
        slope = (left[1] - right[1]) / (left[0] - right[0])
        tilts.add(round(float(slope), 3))
        below = y - (front[1] + slope * (x - front[0]))  # pixels under the tilted line
        image, mask = cut.image(key), cut.mask(key)
        assert (image[below > 1.5] == 255).all()
        assert (mask[below > 1.5] == 0).all()
        above = below < -1.5
        assert np.array_equal(image[above], clip.image(key)[above])
        assert np.array_equal(mask[above], clip.mask(key)[above])
        changed += int((clip.mask(key)[below > 1.5] > 0).sum())
    assert changed > 50  # there was something to cut
    assert max(tilts) - min(tilts) > 0.05
    assert cut.steps[-1].name == "mask_below_neck"


def test_clothes_are_cut_by_their_labels(clip, tmp_path):
    size, labels = (64, 48), np.repeat(np.arange(48, dtype=np.uint8) % 19, 64).reshape(48, 64).T
    clip = with_pixels(clip, tmp_path, np.full((*size, 3), 90, np.uint8), np.full(size, 200, np.uint8))
    (tmp_path / "labels").mkdir()
    for files in clip.files.values():
        write_image(tmp_path / "labels" / f"{files.image.stem}.png", labels)
    cut = without_torso(clip, "bust-line", str(tmp_path / "labels"))
    kept = (labels != 0) & (labels != 16)
    for key in clip.splits["train"]:
        np.testing.assert_array_equal(cut.mask(key), np.where(kept, 200, 0))
        np.testing.assert_array_equal(cut.image(key), np.where(kept[..., None], clip.image(key), 255))
    assert cut_of([asdict(step) for step in cut.steps]) == "parsing"
    assert cut_of([asdict(step) for step in without_torso(clip, "bust-line", "").steps]) == "bust-line"
    assert without_torso(clip, "none", "") is clip


@pytest.mark.parametrize("labels", [np.full((64, 48), 19, np.uint8), np.zeros((64, 48, 3), np.uint8)])
def test_pictures_that_are_no_labels_are_refused(clip, tmp_path, labels):
    clip = with_pixels(clip, tmp_path, np.zeros((64, 48, 3), np.uint8), None)
    for files in clip.files.values():
        write_image(tmp_path / f"{files.image.stem}.png", labels)
    with pytest.raises(InputError, match="labels from 0 to 18"):
        without_torso(clip, "none", str(tmp_path))
