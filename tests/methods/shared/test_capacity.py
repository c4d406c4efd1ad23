"""Avatars of other methods than "ours" with planned sizes, on a toy clip."""

import json
from dataclasses import replace
from math import ceil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from headbench.bench.contracts import Budget, FrameKey, no_progress
from headbench.datasets.synthetic.plan import FRONTAL, SyntheticSettings, load_geometry, plan_subject
from headbench.methods.ga.method import GA
from headbench.methods.ga.spec import GAConfig
from headbench.methods.gbs.method import GBS
from headbench.methods.gbs.spec import BlendshapeTraining, GBSConfig
from headbench.methods.ours.method import plan_capacity
from headbench.methods.ours.spec import OursConfig, PlannedCapacity
from headbench.methods.shared import capacity
from headbench.methods.shared.avatar_files import clip_mesh
from headbench.methods.shared.capacity import CONFIRMED, PictureMotion, picture_motion, with_sizes
from headbench.methods.shared.config import Capacity, SplatTraining
from headbench.methods.shared.surface_points import SubjectMesh

from ...datasets.head.toy import toy_head
from ..toy_clip import ToyClip, splat_pictures, toy_clip

OURS = OursConfig(capacity=PlannedCapacity("auto"))


def trackers(usual):
    """All trackers with their error; those but the usual one are tried in nightly runs."""
    others = {("video", 1.0), ("video", 3.0), ("per-frame", 1.0), ("per-frame", 3.0)} - {usual}
    more = [pytest.param(*other, marks=pytest.mark.slow) for other in sorted(others)]
    return pytest.mark.parametrize(("tracker", "level"), [usual, *more])


class Performer:
    """A synthetic subject and pictures of its exact poses, which cheap splats draw, to be combined with any tracking."""

    def __init__(self, performance, folder):
        self._folder, self._performance = folder, performance
        exact = self._plan("video", 0.0)
        head = exact.geometry.head
        self._offset = np.zeros_like(head.template)
        mesh = SubjectMesh(head, exact.shape, self._offset, "cpu")
        draw = splat_pictures(mesh, waves=400.0)
        poses = [(name, pose) for name, poses in exact.poses.items() for pose in poses]
        self._images, self._splits = {}, {"train": [], "self_reenactment": []}
        for timestep, (sequence, pose) in enumerate(poses):
            split = "self_reenactment" if sequence.startswith("FREE") else "train"
            for name, camera in exact.cameras.items():
                if name != FRONTAL and split == "train":
                    key = FrameKey("toy", sequence, timestep, name)
                    self._images[key], _ = draw(pose, camera)
                    self._splits[split].append(key)

    def _plan(self, tracker, level):
        settings = SyntheticSettings(
            *(1, 3, 60, (72, 104), "procedural", 4100, 0.0, 1),
            performance=self._performance,
            tracker=tracker,
            tracking_error=level,
        )
        return plan_subject(self._folder, 0, load_geometry("procedural"), settings)

    def tracked(self, tracker="video", level=0.0):
        """The clip with tracking errors."""
        plan = self._plan(tracker, level)
        poses = [pose for sequence in plan.writer.plan.sequences for pose in sequence.poses]
        splits = {name: tuple(keys) for name, keys in self._splits.items()}
        return ToyClip(
            *(plan.geometry.head, plan.shape, self._offset, plan.cameras, dict(enumerate(poses))),
            *(splits, self._images, {}, np.ones(3)),
        )


def kept(clip):
    sizes = {each.name: each.chosen for each in plan_capacity(clip, clip_mesh(clip, "cpu"), OURS).decisions}
    return sizes["lines.expressions"], sizes["lines.jaw_bases"]


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    return Performer("still", tmp_path_factory.mktemp("still"))


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    """A performer who uses the whole face, and what is kept of it with exact tracking."""
    performer = Performer("full", tmp_path_factory.mktemp("full"))
    return performer, kept(performer.tracked())


def test_a_still_face_with_exact_tracking_needs_nothing(still):
    assert kept(still.tracked()) == (0, 0)


@trackers(("video", 3.0))
def test_noise_of_the_tracker_is_not_motion(still, tracker, level):
    clip = still.tracked(tracker, level)
    config = GBSConfig(capacity=Capacity("auto"))
    expressions = GBS(config)._planned(clip, config, "cpu").decisions[0]
    assert expressions.numbers["needed"] > 10  # by poses alone
    assert expressions.chosen == 0
    assert kept(clip) == (0, 0)


@trackers(("per-frame", 1.0))
def test_motion_is_kept_whatever_the_tracking_error(full, tracker, level):
    performer, (expressions, jaw_bases) = full
    assert expressions > 20
    assert jaw_bases == 2
    noisy, noisy_jaw = kept(performer.tracked(tracker, level))
    assert noisy >= expressions
    assert noisy_jaw >= jaw_bases


def test_few_timesteps_are_decided_by_poses(full):
    performer, _ = full
    clip = performer.tracked()
    some = tuple(key for key in clip.splits["train"] if key.timestep % 3 == 0)
    short = replace(clip, splits={**clip.splits, "train": some})
    assert picture_motion(short, clip_mesh(short, "cpu"), 1e-3) is None
    assert kept(short)[0] > 0


def test_timesteps_without_frames_of_read_cameras_are_left_out(full, monkeypatch):
    """One frame of each timestep, of the cameras in turn."""
    performer, _ = full
    clip = performer.tracked()
    first, second = sorted({key.camera for key in clip.splits["train"]})
    turns = tuple(
        key for key in clip.splits["train"] if key.camera == (first if key.timestep % 3 else second)
    )
    alternating = replace(clip, splits={**clip.splits, "train": turns})
    mesh = clip_mesh(clip, "cpu")
    with monkeypatch.context() as patch:
        patch.setattr(capacity, "CAMERAS", 1)
        found = picture_motion(alternating, mesh, 1e-3)
    of_first = tuple(key for key in turns if key.camera == first)
    expected = picture_motion(replace(clip, splits={**clip.splits, "train": of_first}), mesh, 1e-3)
    assert np.array_equal(found.pictured, expected.pictured)


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 100))
def test_equal_motion_agrees_whatever_its_unit(seed, unit):
    motion = np.random.default_rng(seed).standard_normal((40, 8))
    same = PictureMotion(motion, unit * motion)
    assert same.agreement(slice(0, 5)) > 5
    assert same.agreement(slice(0, 5)) == pytest.approx(
        PictureMotion(motion, motion).agreement(slice(0, 5)), rel=1e-9
    )
    assert PictureMotion(0 * motion, motion).agreement(slice(0, 5)) == 0


def test_independent_motion_seldom_agrees():
    """Also if both last in time, as the errors of a tracker of videos and the poses of a head do."""
    rng = np.random.default_rng(0)
    confirmed = 0
    for _ in range(200):
        tracked, pictured = (lfilter([1], [1, -0.8], rng.standard_normal((50, 13)), axis=0) for _ in range(2))
        confirmed += PictureMotion(tracked, pictured).agreement(slice(0, 10)) >= CONFIRMED
    assert confirmed <= 20


@pytest.fixture(scope="module")
def clip():
    made = toy_clip(toy_head(16), timesteps=5, cameras=3, width=28, height=36)
    constant = made.poses[0].expression
    return replace(made, poses={t: replace(pose, expression=constant) for t, pose in made.poses.items()})


METHODS = {
    "ga": lambda mode: GA(
        GAConfig(splats=SplatTraining(max_splats=90_000, initial_opacity=0.5), capacity=Capacity(mode))
    ),
    "gbs": lambda mode: GBS(
        GBSConfig(
            splats=BlendshapeTraining(max_splats=90_000),
            samples=200,
            teeth_samples=20,
            mask_floor_mm=0.5,
            capacity=Capacity(mode),
        )
    ),
}


@pytest.mark.parametrize("name", METHODS)
def test_planned_sizes_are_trained_and_recorded(clip, tmp_path, name):
    options = {"budget": Budget(iterations=20), "device": "cpu", "seed": 3, "progress": no_progress}
    for mode in ("auto", "fixed"):
        METHODS[name](mode).fit(clip, tmp_path / mode, **options)
    auto, fixed = (json.loads((tmp_path / mode / "training.json").read_text()) for mode in ("auto", "fixed"))
    assert "capacity" not in fixed
    planned = {each["name"]: each for each in auto["capacity"]["decisions"]}
    splats = planned["splats.max_splats"]
    assert splats["chosen"] == ceil(splats["numbers"]["surface_px"]) < splats["configured"]
    assert splats["chosen"] > splats["numbers"]["least"]
    if name == "gbs":
        assert planned["expressions"]["chosen"] == 0
        size = {
            mode: sum(file.stat().st_size for file in (tmp_path / mode).glob("*"))
            for mode in ("auto", "fixed")
        }
        assert size["auto"] < size["fixed"]


def test_sizes_are_set_by_dotted_name():
    config = with_sizes(GAConfig(), {"sh_degree": 1, "splats.max_splats": 7, "capacity.mode": "auto"})
    assert config == GAConfig(sh_degree=1, splats=SplatTraining(max_splats=7), capacity=Capacity("auto"))
