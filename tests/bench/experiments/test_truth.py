"""Avatars whose faults are known against the path-traced truth: each fails by the measure that is for it."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from headbench.bench.condition import Condition, Named
from headbench.bench.contracts import Camera, Frame, TrueFrame, no_progress
from headbench.bench.engine.config import RunConfig, resolve_cells
from headbench.bench.engine.plan import make_jobs
from headbench.bench.engine.store import RunFolder
from headbench.bench.experiments import extremes
from headbench.bench.experiments.robustness import ExtremesSettings
from headbench.bench.experiments.truth import TRUTH_LIMITS, TruthJudge, TruthPair, TruthPictures
from headbench.datasets.open import open_clip
from headbench.datasets.synthetic.capture import synthesize
from headbench.reports.contact_sheet import SHEET_FILE, table, write_extremes_sheet

from ...datasets.flat_renderer import flat_pictures

PARAMETERS = ExtremesSettings("run", views=2, beyond=15.0, dimensions=2, samples=2, path=2).parameters
FRAMES, SAMPLES = 2 + 2 * 2 + 2, 2 * 2


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    """A cell of a small synthetic capture; its truth is rendered once for all avatars."""
    root = tmp_path_factory.mktemp("truth")
    how = {"performance": "full", "workers": 1, "tracking_error": 1.0, "samples_per_pixel": 4}
    with flat_pictures():  # of which the truth needs none
        (capture,) = synthesize(root / "data", cameras=3, timesteps=8, size=(32, 46), **how)
    condition = Condition(drive=Named("extremes", PARAMETERS))
    config = RunConfig(
        data=str(root / "data"), out=str(root / "run"), methods=("mean-image",), conditions=(condition,)
    )
    (job,) = make_jobs(config, resolve_cells(config), [open_clip(capture)], {}, RunFolder(root / "run"))
    return replace(job, protocols=extremes.protocols([job], **PARAMETERS))


class TrueAvatar:
    """Returns the truth of a pose, or of ``always``, after a ``change`` of its colours (H, W, 3) and coverage (H, W)."""

    def __init__(self, job, change=lambda rgb, alpha: rgb, always=None):
        self._truths, self._change, self._always = TruthPictures.of(job), change, always

    def depth(self, camera, pose):
        return self._truths.at(camera, self._always or pose)[0].depth

    def render(self, camera, pose, background=(1.0, 1.0, 1.0)):
        truth, _ = self._truths.at(camera, self._always or pose)
        alpha = (truth.mask / 255.0).astype(np.float32)
        return Frame(np.float32(self._change(truth.rgb / 255.0, alpha[..., None])), alpha)

    def files(self):
        return []


def driven(job, *given, **settings):
    (record,) = extremes.drive(job, TrueAvatar(job, *given, **settings), no_progress, **PARAMETERS)[1][
        "avatars"
    ]
    return record


def noise(rgb, alpha):
    return alpha * np.random.default_rng(0).random(rgb.shape) + 1.0 - alpha


def blurred(rgb, alpha):
    return cv2.GaussianBlur(rgb, (0, 0), 1.5 * TRUTH_LIMITS.blur_beyond * len(rgb))


def swapped(rgb, alpha):
    return rgb[..., ::-1]


def tinted(rgb, alpha):
    return alpha * np.clip(rgb * [1.15, 1.0, 0.85], 0.0, 1.0) + 1.0 - alpha


@pytest.mark.parametrize(
    ("change", "measures"),
    [
        (noise, {"psnr", "psnr face", "colour"}),
        (blurred, {"psnr", "psnr face"}),
        (swapped, {"psnr face", "colour"}),
        (tinted, {"colour"}),
    ],
)
def test_a_spoilt_picture_fails_in_every_frame(job, change, measures):
    record = driven(job, change)
    assert record["frames_broken"] == record["frames"] == FRAMES
    for name in measures:
        assert record["measures"][name]["failed"] == FRAMES, name
    assert record["measures"]["coverage"]["failed"] == 0  # as the measures without truth see it, all is well
    assert record["measures"]["iou"]["failed"] == 0


def test_a_frozen_face_fails_by_its_response(job):
    typical = extremes.ExtremesPlan.of(job.form.clip, **PARAMETERS).frames[0].pose
    found = driven(job, always=typical)["measures"]["response"]
    assert (
        2 * SAMPLES / 3 <= found["failed"] == found["frames"] <= SAMPLES
    )  # of profiles there may be no face in view
    assert found["mean"] == found["worst"] == 0.0


def test_an_avatar_that_is_the_person_passes(job, tmp_path):
    rows, details = extremes.drive(job, TrueAvatar(job), no_progress, **PARAMETERS)
    (record,) = details["avatars"]
    assert record["frames_broken"] == 0
    values = {name: found["worst"] for name, found in record["measures"].items()}
    assert values["psnr"] == values["psnr face"] == 100.0
    assert values["iou"] == pytest.approx(1.0)
    assert values["response"] == 1.0
    assert values["depth face"] == 0.0
    assert values["normals face"] == pytest.approx(0.0, abs=1e-5)
    assert values["colour"] == values["flicker"] == 0.0
    assert "psnr face" in table([record])
    truths = [*(job.run / "truth").glob("*.png")]
    frames = extremes.ExtremesPlan.of(job.form.clip, **PARAMETERS).frames
    shown = {(f.view, f.pose.expression.tobytes(), f.pose.jaw.tobytes()) for f in frames}
    assert len(truths) == 2 * len(shown)  # a picture and a mask; the path starts in the typical pose
    assert rows.metrics >= {"psnr", "iou", "colour", "response", "flicker"}
    write_extremes_sheet(job.run, [record])
    assert (job.run / SHEET_FILE).exists()


def test_pictures_are_rendered_once_and_again_if_damaged(tmp_path):
    asked = []

    def render(camera, pose):
        asked.append((camera.width, camera.height))
        face = np.zeros((10, 8), bool)
        face[2:5, 3] = True
        return TrueFrame(np.full((10, 8, 3), 40, np.uint8), np.full((10, 8), 130, np.uint8), face)

    truths = TruthPictures(
        SimpleNamespace(fingerprint="a", render=render, depth=lambda camera, pose: np.ones((10, 8))),
        tmp_path,
        10,
    )
    camera = Camera("c", 16, 20, np.diag([20.0, 20.0, 1.0]), np.eye(4))
    pose = SimpleNamespace(head_model="m", expression=np.zeros(3), jaw=np.zeros(3), eyelids=None)
    pose = SimpleNamespace(**vars(pose), rotation=None, neck=None, eyes=None, translation=None)
    assert truths.missing([(camera, pose), (camera, pose)]) == 1
    first, files = truths.at(camera, pose)
    assert truths.missing([(camera, pose)]) == 0
    second, same = truths.at(replace(camera, id="another"), pose)
    assert asked == [(8, 10)]  # at the capture's size
    assert files == same
    assert all(np.array_equal(a, b) for a, b in zip(first, second))
    pose.jaw = np.array([0.1, 0.0, 0.0])
    assert truths.at(camera, pose)[1] != files
    pose.jaw = np.zeros(3)
    files[1].write_bytes(b"")
    assert np.array_equal(truths.at(camera, pose)[0].mask, first.mask)
    assert len(asked) == 3


@pytest.fixture
def judge():
    return TruthJudge()


@pytest.fixture
def pair():
    """Two frames of a truth that is a step, and the step's shift."""
    rng = np.random.default_rng(1)
    face = np.ones((40, 40), bool)
    pictures = rng.integers(60, 190, (2, 40, 40, 3)).astype(np.uint8)
    return [TrueFrame(picture, np.full((40, 40), 255, np.uint8), face) for picture in pictures]


def shown(truth, picture):
    return TruthPair(np.asarray(picture, np.uint8), np.ones((40, 40)), truth)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_the_response_is_the_share_of_the_change_that_is_shown(judge, pair, share):
    before, after = pair
    moved = before.rgb + np.round(share * (after.rgb.astype(float) - before.rgb))
    offset = 30  # which both frames have, and which does not count
    frames = shown(after, moved + offset), shown(before, before.rgb + offset)
    check = judge.response(*frames)
    assert check.value == pytest.approx(share, abs=0.01)
    assert check.passed == (share > TRUTH_LIMITS.response)


def test_flicker_is_limited_by_that_of_standing_still(judge, pair):
    before, after = pair
    change = np.sqrt(((after.rgb.astype(float) - before.rgb) ** 2).mean())
    still = judge.flicker(shown(after, before.rgb), shown(before, before.rgb))
    assert still.value == pytest.approx(change)
    assert still.upper == pytest.approx(TRUTH_LIMITS.flicker * change)
    assert still.passed
    opposite = np.clip(128.0 - (after.rgb.astype(float) - before.rgb), 0, 255)
    wrong = judge.flicker(shown(after, opposite), shown(before, np.full_like(before.rgb, 128)))
    assert wrong.value == pytest.approx(2 * change, rel=0.01)
    assert not wrong.passed


def test_overlap_and_colour_are_those_counted_by_hand(judge):
    truth = TrueFrame(
        np.full((40, 40, 3), 128, np.uint8), np.zeros((40, 40), np.uint8), np.ones((40, 40), bool)
    )
    truth.mask[:, :20] = 255
    alpha = np.zeros((40, 40))
    alpha[:, 10:20], alpha[:, 20:30] = 1.0, 0.5
    grey = np.full((40, 40, 3), 128, np.uint8)
    checks = {check.measure: check for check in judge.appearance(TruthPair(grey, alpha, truth))}
    assert checks["iou"].value == pytest.approx(10 / (20 + 0.5 * 10))
    assert checks["colour"].value == pytest.approx(0.0)
    assert not checks["iou"].passed
    lighter = judge.appearance(TruthPair(grey + 20, alpha, truth))[-1]
    # CIE L* of 128 and of 148 in sRGB by its definition; CIEDE2000 of greys is their difference over its weight.
    low, high = (116 * (((v / 255 + 0.055) / 1.055) ** 2.4) ** (1 / 3) - 16 for v in (128, 148))
    middle = ((low + high) / 2 - 50) ** 2
    assert lighter.value == pytest.approx(
        (high - low) / (1 + 0.015 * middle / np.sqrt(20 + middle)), abs=0.05
    )


def test_frames_are_brought_to_the_size_of_the_truth_if_finite(judge, pair):
    rgb = np.full((40, 40, 3), np.nan, np.float32)
    assert TruthPair.of(Frame(rgb, np.ones((40, 40), np.float32)), pair[0]) is None
    assert {check.value for check in judge.appearance(None)} == {None}
    assert judge.response(None, None).outcome == ("missing", "the frame is not finite")
    large = np.repeat(np.repeat(pair[0].rgb / 255.0, 2, axis=0), 2, axis=1)
    found = TruthPair.of(Frame(np.float32(large), np.ones((80, 80), np.float32)), pair[0])
    assert np.array_equal(found.picture, pair[0].rgb)
    assert found.alpha.shape == (40, 40)
