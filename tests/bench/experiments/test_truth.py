"""Avatars whose faults are known against the path-traced truth: each fails by the measure that is for it."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from headbench.bench.condition import PLAIN, Condition, Named
from headbench.bench.contracts import Camera, Frame, FrameKey, HeadPose, TrueFrame, no_progress
from headbench.bench.engine.config import RunConfig, resolve_cells
from headbench.bench.engine.plan import make_jobs
from headbench.bench.engine.store import RunFolder
from headbench.bench.experiments import extremes
from headbench.bench.experiments.extremes import ExtremesPlan, ExtremesSettings, GivenFrame
from headbench.bench.experiments.refit import FrameFit, refit
from headbench.bench.experiments.truth import TRUTH_LIMITS, TruthJudge, TruthPair, TruthPictures
from headbench.bench.experiments.viewpoints import head_center
from headbench.bench.io.images import quantise
from headbench.datasets.head.geometry import project
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.open import open_clip
from headbench.datasets.synthetic.capture import synthesize
from headbench.reports.contact_sheet import SHEET_FILE, table, write_extremes_sheet
from headbench.reports.table_report import table_text

from ...datasets.flat_renderer import flat_pictures
from ...world import rows_of, run_on

SIDE, KEY = 40, FrameKey("blobs", "FREE", 9, "front")
RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-0.1, 0.1, (12, 3))
COLOURS = RNG.uniform(0.0, 0.8, (12, 3))
BASIS = np.zeros((12, 3, 3))
BASIS[0, 1, 0] = BASIS[1, 0, 1] = BASIS[2, 2, 2] = 0.02


class Blobs:
    """Smooth spots, some of which expression and jaw move; it knows nothing of the timestep."""

    def pixels(self, camera, pose):
        points = POINTS + BASIS @ pose.expression
        points[3:5, 1] += 0.1 * pose.jaw[0]
        local = (points + pose.translation) @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        seen = local @ camera.K.T
        return seen[:, :2] / seen[:, 2:]

    def render(self, camera, pose, background=(1.0, 1.0, 1.0)):
        v, u = np.mgrid[: camera.height, : camera.width] + 0.5
        rgb = np.ones((camera.height, camera.width, 3)) * background
        for (x, y), colour in zip(self.pixels(camera, pose), COLOURS):
            weight = np.exp(-((u - x) ** 2 + (v - y) ** 2) / (0.005 * camera.width**2))[..., None]
            rgb = rgb * (1 - weight) + weight * colour
        return Frame(rgb.astype(np.float32), np.ones(rgb.shape[:2], np.float32))


class Fixed(Blobs):
    """It shows the same whatever the view is."""

    def render(self, camera, pose, background=(1.0, 1.0, 1.0)):
        return Frame(np.full((camera.height, camera.width, 3), 0.5, np.float32), None)


@pytest.fixture
def clip():
    """Tracked, with training poses that vary in all three coefficients and the jaw; pictures are set by tests."""
    K = np.array([[100.0, 0, SIDE / 2], [0, 100.0, SIDE / 2], [0, 0, 1]])
    place = np.eye(4)
    place[2, 3] = 0.6
    zero = np.zeros(3)
    poses = {
        t: HeadPose(
            "blobs", RNG.normal(size=3), zero, zero, np.array([RNG.uniform(0, 0.2), 0, 0]), zero, zero
        )
        for t in range(9)
    }
    tracked = replace(poses[4], subject="blobs", timestep=9)
    head = SimpleNamespace(
        template=POINTS, shape_basis=np.zeros((12, 3, 1)), joint_regressor=np.full((1, 12), 1 / 12)
    )
    return SimpleNamespace(
        head=head,
        shape=np.zeros(1),
        cameras={"front": Camera("front", SIDE, SIDE, K, place)},
        poses={**poses, 9: tracked},
        splits={"train": [KEY._replace(timestep=t) for t in poses]},
    )


def test_a_view_with_an_error_is_recovered(clip):
    avatar, camera, tracked = Blobs(), clip.cameras["front"], clip.poses[9]
    frame = FrameFit(avatar, camera, tracked, None, (1, 1, 1), head_center(clip), np.eye(6)[:4])
    parameters = np.array([0.5, -0.5, 0.5, 0.6, -0.6, 0.6, 0.5, 0, 0, 0.3, -0.3, 0.3, 0])
    true = frame.view(parameters)
    picture = quantise(avatar.render(*true).rgb)
    clip.image = lambda key: picture if key == KEY else pytest.fail("another picture was read")

    def error(view):
        return np.linalg.norm(avatar.pixels(*view) - avatar.pixels(*true), axis=1).mean()

    def psnr(view):
        return -10 * np.log10(np.mean((quantise(avatar.render(*view).rgb) / 255.0 - picture / 255.0) ** 2))

    fitted = refit(avatar, clip, KEY, (1.0, 1.0, 1.0))
    assert error((camera, tracked)) > 0.5
    assert error(fitted) < error((camera, tracked)) / 10
    assert psnr(fitted) > psnr((camera, tracked)) + 10
    assert fitted[1].timestep is None


@pytest.mark.parametrize("avatar", [Blobs(), Fixed()])
def test_the_tracked_view_is_kept_if_none_is_better(clip, avatar):
    tracked = clip.cameras["front"], clip.poses[9]
    clip.image = lambda key: quantise(avatar.render(*tracked).rgb)
    assert all(a is b for a, b in zip(refit(avatar, clip, KEY, (1.0, 1.0, 1.0)), tracked))


def test_rows_name_the_condition_and_no_frame_becomes_worse(balls, tmp_path, monkeypatch):
    monkeypatch.setattr(balls.Ball, "render", Blobs.render)  # instead of a hard edge
    monkeypatch.setattr(balls.Ball, "pixels", Blobs.pixels, raising=False)
    views = Condition("test-refit", views=Named("test-refit", {"iterations": 1}))
    names = ("ball_plugin:BALL", "ball_plugin:LISTED")
    how = {"reader": "ball_plugin:READER", "metrics": ("psnr",), "conditions": (PLAIN, views)}
    run = run_on(tmp_path / "data", tmp_path / "run", *names, subjects=("ball-a",), **how)
    rows = rows_of(run).query("metric == 'psnr' and region == 'full'")
    own = rows.pivot_table("value", ["task", "timestep", "camera"], ["method", "condition"])
    assert list(own.columns) == [("ball", ""), ("ball", "test-refit"), ("listed", "")]
    assert (own["ball", "test-refit"] >= own["ball", ""]).all()
    assert (own["ball", "test-refit"] > own["ball", ""]).any()
    refused = rows[(rows["method"] == "listed") & (rows["condition"] == "test-refit")]
    assert refused["reason"].str.contains("Frames come in lists alone").all()
    assert not run.cell("ball-a", "ball+test-refit", 0).avatar.exists()
    assert "ball+test-refit, listed+test-refit: each scored frame was fitted to its own" in table_text(
        [run.root]
    )


PARAMETERS = ExtremesSettings("run", views=2, beyond=15.0, dimensions=2, samples=2, path=2).parameters
FRAMES, SAMPLES = 2 + 2 * 2 + 2, 2 * 2


@pytest.fixture(scope="module")
def jobs(tmp_path_factory):
    """Cells of a small synthetic capture by method: `gbs` is given the clip in another head model, as one video."""
    root = tmp_path_factory.mktemp("truth")
    how = {"performance": "full", "workers": 1, "tracking_error": 1.0, "samples_per_pixel": 4}
    with flat_pictures():  # of which the truth needs none
        (capture,) = synthesize(root / "data", cameras=3, timesteps=8, size=(32, 46), **how)
    condition = Condition(drive=Named("extremes", PARAMETERS))
    config = RunConfig(
        data=str(root / "data"), out=str(root / "run"), methods=("mean-image", "gbs"), conditions=(condition,)
    )
    found = make_jobs(config, resolve_cells(config), [open_clip(capture)], {}, RunFolder(root / "run"))
    return {
        job.method.spec.name: replace(job, protocols=extremes.protocols([job], **PARAMETERS)) for job in found
    }


@pytest.fixture(scope="module")
def job(jobs):
    """A cell whose truth is rendered once for all avatars."""
    return jobs["mean-image"]


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


class InOrder(TrueAvatar):
    """Returns the truth of the planned frames, whatever it is given, which it keeps."""

    def __init__(self, job):
        super().__init__(job)
        self._plan, self.given = ExtremesPlan.of(job.clip, **PARAMETERS), []

    def render(self, camera, pose, background=(1.0, 1.0, 1.0)):
        frame = self._plan.frames[len(self.given)]
        self.given.append((camera, pose))
        return super().render(self._plan.views[frame.view].camera, frame.pose)

    def depth(self, camera, pose):
        return np.ones((camera.height, camera.width), np.float32)


def test_a_method_of_another_head_model_has_the_same_frames(jobs):
    """Its poses and cameras show the face where those of the plan do."""
    job = jobs["gbs"]
    ((own,), (others,)) = (each.protocols.values() for each in (job, jobs["mean-image"]))
    assert own.hash == others.hash
    avatar = InOrder(job)
    (record,) = extremes.drive(job, avatar, no_progress, **PARAMETERS)[1]["avatars"]
    assert "no_truth" not in record
    assert record["measures"]["psnr face"]["worst"] == 100.0
    assert record["frames"] == FRAMES == len(avatar.given)
    plan = ExtremesPlan.of(job.clip, **PARAMETERS)
    for (camera, pose), frame in zip(avatar.given, plan.frames):
        assert pose.head_model == job.form.clip.head.version != job.clip.head.version
        assert pose.timestep is None
        assert not np.any([pose.rotation, pose.translation])
        shown = [(job.form.clip, camera, pose), (job.clip, plan.views[frame.view].camera, frame.pose)]
        mine, planned = (
            project(PosedSubject.of(clip).meshes([p])[0][clip.head.regions["face"]], c)
            for clip, c, p in shown
        )
        assert np.linalg.norm(mine - planned, axis=1).mean() < 0.1  # pixels


def test_what_a_method_does_not_show_has_no_coverage():
    given = GivenFrame(
        None, None, lambda image: np.pad(image[1:-1], ((1, 1), (0, 0), (0, 0)), constant_values=1)
    )
    frame = given.restored(Frame(np.full((4, 3, 3), 0.5, np.float32), np.full((4, 3), 0.25, np.float32)))
    np.testing.assert_array_equal(frame.alpha[:, 0], [0, 0.25, 0.25, 0])
    np.testing.assert_array_equal(frame.rgb[:, 0, 0], [1, 0.5, 0.5, 1])


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
    )
    camera = Camera("c", 8, 10, np.diag([20.0, 20.0, 1.0]), np.eye(4))
    pose = SimpleNamespace(head_model="m", expression=np.zeros(3), jaw=np.zeros(3), eyelids=None)
    pose = SimpleNamespace(**vars(pose), rotation=None, neck=None, eyes=None, translation=None)
    assert truths.missing([(camera, pose), (camera, pose)]) == 1
    first, files = truths.at(camera, pose)
    assert truths.missing([(camera, pose)]) == 0
    second, same = truths.at(replace(camera, id="another"), pose)
    assert asked == [(8, 10)]
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


def test_frames_that_are_not_finite_are_not_compared(judge, pair):
    rgb = np.full((40, 40, 3), np.nan, np.float32)
    assert TruthPair.of(Frame(rgb, np.ones((40, 40), np.float32)), pair[0]) is None
    assert {check.value for check in judge.appearance(None)} == {None}
    assert judge.response(None, None).outcome == ("missing", "the frame is not finite")
    assert TruthPair.of(Frame(np.ones_like(rgb), rgb[..., 0]), pair[0]) is None
    found = TruthPair.of(Frame(np.float32(pair[0].rgb / 255.0), np.ones((40, 40), np.float32)), pair[0])
    assert np.array_equal(found.picture, pair[0].rgb)
