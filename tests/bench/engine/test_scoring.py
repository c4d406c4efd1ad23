"""Scoring of stored frames: what a metric is called with, and what becomes of frames it cannot score."""

import math
import threading
import types
from types import SimpleNamespace

import numpy as np
import pytest

from headbench.bench.contracts import Frame, FrameKey
from headbench.bench.engine import scoring
from headbench.bench.engine.cell import training_poses
from headbench.bench.engine.config import RunConfig, resolve_metrics
from headbench.bench.engine.scoring import (
    ScoredFrames,
    TrainingView,
    check_frame,
    check_regions,
    score_frames,
)
from headbench.bench.errors import HeadbenchError, InputError, LeftOutError, UnavailableError
from headbench.bench.specs import MetricSpec


@pytest.fixture
def view(toy, tmp_path):
    return TrainingView(toy.ToyClip(tmp_path / "s"))


@pytest.mark.parametrize("split", ["novel_view", "self_reenactment"])
@pytest.mark.parametrize("read", ["image", "mask"])
def test_a_held_out_frame_cannot_be_read(view, split, read):
    assert view.image(view.splits["train"][0])[0, 0, 0] == 40
    with pytest.raises(HeadbenchError, match="not a training frame"):
        getattr(view, read)(view.splits[split][0])


CHANGES = {
    "camera": lambda view: view.cameras["a"].K.fill(0),
    "expression": lambda view: view.poses[0].expression.fill(0),
    "shape": lambda view: view.shape.fill(0),
    "image": lambda view: view.image(view.splits["train"][0]).fill(0),
    "image, flag": lambda view: view.image(view.splits["train"][0]).setflags(write=True),
    "poses": lambda view: view.poses.clear(),
    "splits": lambda view: view.splits.update(train=()),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_shared_inputs_are_read_only(view, change):
    with pytest.raises((ValueError, AttributeError)):
        change(view)


@pytest.mark.parametrize(
    ("rgb", "alpha", "match"),
    [
        (np.full((2, 3, 3), 1.0005), np.zeros((2, 3)), None),
        (np.full((2, 3, 3), 1.002), np.zeros((2, 3)), "rgb of .*from 1.002"),
        (np.full((2, 3, 3), -np.inf), np.zeros((2, 3)), "rgb"),
        (np.zeros((2, 3, 3)), np.full((2, 3), np.nan), "alpha of .*nan"),
        (np.zeros((3, 2, 3)), np.zeros((2, 3)), "rgb of .*shape"),
        (np.zeros((2, 3, 3)), np.zeros((2, 3, 1)), "alpha of .*shape"),
    ],
)
def test_size_and_values_of_a_frame_are_checked(rgb, alpha, match):
    key = FrameKey("s", "EMO", 0, "a")
    if match is None:
        check_frame(Frame(rgb, alpha), (2, 3), "cell", key)
    else:
        with pytest.raises(InputError, match=match):
            check_frame(Frame(rgb, alpha), (2, 3), "cell", key)


KEYS = [FrameKey("s", sequence, t, "a") for sequence, t in [("EMO", 0), ("EMO", 1), ("EMO", 2), ("FREE", 7)]]


class RegionalToyClip:
    """Truth of level 10 t; the right half is the face, which nobody sees at timestep 2."""

    subject = "s"
    region_names = ("face", "hair")

    def image(self, key):
        return np.full((4, 6, 3), 10 * key.timestep, np.uint8)

    def region_masks(self, key, names):
        half = np.zeros((4, 6), bool)
        half[:, 3:] = key.timestep != 2
        return dict.fromkeys(names, half)


def render(key):
    image = np.full((4, 6, 3), 10 * key.timestep + 1, np.uint8)
    image[:, 3:] += 4
    return image


class Difference:
    """Mean difference in levels."""

    def __call__(self, image, truth):
        return float((image.astype(float) - truth).mean())

    def in_regions(self, image, truth, masks):
        return {n: float((image.astype(float) - truth)[m].mean()) for n, m in masks.items() if m.any()}


class Batched(Difference):
    """The same by batches."""

    def batched(self, pairs):
        for image, truth in pairs:
            yield self(image, truth)


def video(images, truths):
    """Number of frames, in the order of time."""
    levels = [int(truth[0, 0, 0]) for truth in truths]
    assert levels == sorted(levels)
    assert len(images) == len(truths)
    return len(images)


def largest(pairs):
    """Of the ground truth of all frames."""
    return max(int(truth.max()) for _, truth in pairs)


def change(image, truth, other_image, other_truth):
    return float(image.astype(float).mean() - other_image.astype(float).mean())


def face_level(image, truth, face):
    if not face.any():
        raise LeftOutError("no face is seen")
    return float((image.astype(float) - truth)[face].mean())


def unavailable(image, truth):
    raise UnavailableError("no weights.", "Get some.")


def noted(*images):
    raise UnavailableError("no weights.", "Get some.", "Weights missing.")


def faceless(*images):
    raise LeftOutError("no face is found")


class NotedBatches(Difference):
    batched = staticmethod(noted)


def not_finite(image, truth):
    return math.inf


@pytest.fixture
def spec(monkeypatch):
    def make(name, implementation, **fields):
        monkeypatch.setattr(scoring, "resolve", lambda reference: globals()[reference])
        return MetricSpec(name, name, "", True, 2, implementation, **fields)

    return make


FRAMES = ScoredFrames(render, RegionalToyClip())


def test_frames_and_regions_are_scored_in_the_order_of_keys(spec):
    scored = score_frames(KEYS, FRAMES, [spec("d", "Difference", kind="regional")], ["face"])["d"]
    full = [s for s in scored if s.region == "full"]
    assert [(s.key, s.value, s.status) for s in full] == [(key, 3.0, "ok") for key in KEYS]
    face = [s for s in scored if s.region == "face"]
    # nobody sees the face at timestep 2: no row there, for any method
    assert [(s.key.timestep, s.value) for s in face] == [(0, 5.0), (1, 5.0), (7, 5.0)]


def test_a_metric_without_regions_is_asked_for_none(spec):
    scored = score_frames(KEYS, FRAMES, [spec("d", "Difference")], ["face"])["d"]
    assert {s.region for s in scored} == {"full"}


def test_a_metric_by_batches_has_the_same_scores(spec):
    specs = [spec("one", "Difference"), spec("many", "Batched")]
    scored = score_frames(KEYS, FRAMES, specs)
    assert [s[1:] for s in scored["one"]] == [s[1:] for s in scored["many"]]


def test_batches_read_a_bounded_number_of_frames_ahead(spec, monkeypatch):
    keys = [FrameKey("s", "EMO", t, "a") for t in range(200)]
    lock, read, asked, worst = threading.Lock(), [0], [0], [0]

    def counted(key):
        with lock:
            read[0] += 1
            worst[0] = max(worst[0], read[0] - asked[0])
        return np.zeros((4, 6, 3), np.uint8)

    class Slow:
        def batched(self, pairs):
            for _ in pairs:
                asked[0] += 1
                yield 0.0

    clip = types.SimpleNamespace(image=lambda key: np.zeros((4, 6, 3), np.uint8))
    many = spec("many", "Batched")
    monkeypatch.setattr(scoring, "resolve", lambda reference: Slow)
    assert len(score_frames(keys, ScoredFrames(counted, clip), [many])["many"]) == 200
    assert worst[0] <= scoring._AHEAD + 2


def test_a_temporal_metric_sees_the_neighbouring_frame(spec):
    scored = score_frames(KEYS, FRAMES, [spec("t", "change", kind="temporal")])["t"]
    assert [s.value for s in scored[:3]] == [-10.0, 10.0, 10.0]
    assert scored[3].status == "missing"
    assert "neighbouring" in scored[3].reason


def test_a_metric_of_the_face_is_given_its_pixels(spec):
    faces = spec("f", "face_level", kind="face")
    scored = score_frames(KEYS, FRAMES, [faces])["f"]
    assert [(s.key, s.region) for s in scored] == [(key, "full") for key in KEYS]
    assert [s.value for s in scored if s.status == "ok"] == [5.0, 5.0, 5.0]
    assert (scored[2].status, scored[2].reason) == ("missing", "left out: no face is seen")
    plain = ScoredFrames(render, SimpleNamespace(image=RegionalToyClip().image))
    assert {s.reason for s in score_frames(KEYS, plain, [faces])["f"]} == {
        "The reader does not locate the face."
    }


def test_all_frames_of_a_sequence_have_the_value_of_their_video(spec):
    scored = score_frames(KEYS, FRAMES, [spec("v", "video", kind="sequence")])["v"]
    assert [s.value for s in scored] == [3.0, 3.0, 3.0, 1.0]
    assert [s.key for s in scored] == KEYS


def test_all_frames_have_the_value_of_their_set(spec):
    scored = score_frames(KEYS, FRAMES, [spec("l", "largest", kind="set")])["l"]
    assert {s.value for s in scored} == {max(float(FRAMES.clip.image(key).max()) for key in KEYS)}
    assert [s.key for s in scored] == KEYS


@pytest.mark.parametrize(
    ("implementation", "fields", "reason"),
    [
        ("unavailable", {}, "no weights. Get some."),
        ("faceless", {}, "left out: no face is found"),
        ("noted", {}, "Weights missing."),
        ("noted", {"kind": "face"}, "Weights missing."),
        ("noted", {"kind": "temporal"}, "Weights missing."),
        ("noted", {"kind": "sequence"}, "Weights missing."),
        ("noted", {"kind": "set"}, "Weights missing."),
        ("NotedBatches", {}, "Weights missing."),
    ],
)
def test_what_cannot_be_had_is_missing_with_the_reason(spec, implementation, fields, reason):
    scored = score_frames(KEYS[:3], FRAMES, [spec("u", implementation, **fields)])["u"]
    assert {(s.status, s.reason) for s in scored} == {("missing", reason)}
    assert all(math.isnan(s.value) for s in scored)


def test_a_value_that_is_not_finite_is_an_error(spec):
    with pytest.raises(HeadbenchError, match=r"s/EMO/00000/a is inf"):
        score_frames(KEYS, FRAMES, [spec("n", "not_finite")])


def test_regions_default_to_the_face_where_the_clip_knows_it():
    clip = RegionalToyClip()
    assert check_regions(clip, None) == ("face",)
    assert check_regions(clip, ("full", "hair", "hair")) == ("hair",)
    assert check_regions(clip, ()) == ()
    plain = types.SimpleNamespace(subject="s")
    assert check_regions(plain, None) == ()
    with pytest.raises(InputError, match=r"regions, mouth: expected one of full, face, hair"):
        check_regions(clip, ("mouth",))


def resolved(**settings):
    return [spec.name for spec in resolve_metrics(RunConfig("data", "out", **settings))]


def test_metrics_are_resolved_in_every_profile_and_others_once():
    assert resolved()[:5] == ["psnr", "ssim", "lpips", "storage", "fps"]
    names = resolved(metrics=("psnr", "ssim", "fps"), metric_profiles=("canonical", "3dgs"))
    assert names == ["psnr", "psnr@3dgs", "ssim", "ssim@3dgs", "fps"]
    assert resolved(metrics=("ssim",), metric_profiles=("skimage",)) == ["ssim@skimage"]


def test_the_first_profile_is_compared_others_have_own_tables():
    names = ("3dgs", "canonical", "skimage")
    specs = resolve_metrics(RunConfig("data", "out", metrics=("ssim",), metric_profiles=names))
    assert {spec.name: spec.tables for spec in specs} == {
        "ssim@3dgs": ("comparison", "3dgs"),
        "ssim": ("comparison",),
        "ssim@skimage": ("skimage",),
    }


def test_unknown_profiles_and_undefined_metrics_are_refused():
    with pytest.raises(InputError, match="Did you mean 'skimage'"):
        resolved(metric_profiles=("skimge",))
    with pytest.raises(InputError, match=r"metrics, lpips: expected one that the profiles skimage define"):
        resolved(metric_profiles=("skimage",))


class OnDevice(Batched):
    """The same, one level more on a device other than the CPU."""

    def __init__(self, device="cpu"):
        self.device = device

    def on(self, device):
        return OnDevice(device)

    def __call__(self, image, truth):
        return super().__call__(image, truth) + (self.device != "cpu")


# Results of a run on a GPU are measured on the CPU where there is none.
@pytest.mark.parametrize(
    ("device", "there", "more"),
    [("cpu", True, 0), ("mps", True, 0), ("cuda:1", True, 1), ("cuda:1", False, 0)],
)
def test_a_metric_that_can_computes_on_the_gpu_of_the_run(monkeypatch, device, there, more):
    cuda = SimpleNamespace(is_available=lambda: there)
    monkeypatch.setattr(scoring, "resolve", lambda name: cuda if name == "torch:cuda" else OnDevice)
    spec = MetricSpec("d", "D", "", False, 1, "there:OnDevice", "a difference")
    (plain,) = score_frames(KEYS[:1], ScoredFrames(render, RegionalToyClip()), [spec])["d"]
    (found,) = score_frames(KEYS[:1], ScoredFrames(render, RegionalToyClip()), [spec], device=device)["d"]
    assert found.value == plain.value + more


@pytest.mark.parametrize("count", [1, 3, 200, 500])
def test_a_mechanism_is_measured_over_training_timesteps(count):
    """Each once and in order, evenly thinned if they are many."""
    train = [FrameKey("s", "EMO", 10 * t, camera) for t in reversed(range(count)) for camera in "ba"]
    clip = SimpleNamespace(
        splits={"train": train, "novel_view": [FrameKey("s", "EMO", 5, "a")]},
        cameras={name: name for name in "ab"},
        poses={t: t for t in range(10 * count)},
    )
    cameras, poses = zip(*training_poses(clip))
    assert set(cameras) == {"a"}
    assert len(poses) == min(count, 200)
    assert poses[0] == 0
    steps = np.diff(poses)
    assert set(steps) <= ({10} if count <= 200 else {20, 30})
