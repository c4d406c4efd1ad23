"""The truth of a capture in other poses and views: at the capture's own it is the capture's picture."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.contracts import StepRecord
from headbench.bench.errors import UnavailableError
from headbench.bench.registry import get, resolve
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.open import open_clip
from headbench.datasets.synthetic import capture
from headbench.datasets.synthetic.performance import EXPRESSION_CONTROLS
from headbench.datasets.synthetic.plan import FRONTAL
from headbench.datasets.synthetic.renderer import SyntheticTruth

from .conftest import SMALL


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    """A capture whose expression never changes, so that the state of the skin has no history; one timestep is drawn."""
    out = tmp_path_factory.mktemp("still")
    changes = {"performance": "still", "camera_colour": 1.0, "mask_error": 1.0}
    render, blank = capture.CaptureRenderer.render_frames, np.zeros((46, 32, 3), np.uint8)

    def one(self, sequence, timestep, cameras):
        if (sequence, timestep) == ("EMO-1-shout+laugh", 1):
            return render(self, sequence, timestep, cameras)
        for name in cameras:
            self._plan.writer.write_frame(sequence, timestep, name, blank, blank[..., 0])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(capture.CaptureRenderer, "render_frames", one)
        (union,) = capture.synthesize(out, **{**SMALL, **changes})
    return open_clip(union, settings={"leaks": "record"})


@pytest.fixture(scope="module")
def moving(request):
    return open_clip(request.getfixturevalue("capture")[1])


def decibels(a, b):
    return -10 * np.log10(((a.astype(float) - b) ** 2).mean() / 255**2)


@pytest.fixture(scope="module")
def truth(still):
    return resolve(get("datasets", "synthetic").truth)(still)


def test_at_a_frame_of_the_capture_it_has_its_bytes(still, truth):
    key = next(key for key in still.splits["novel_view"] if key.timestep == 1)
    seed = truth._plan.render_seed(key.sequence, key.timestep, key.camera)
    picture, mask, face, _ = truth.render(still.cameras[key.camera], still.poses[key.timestep], seed)
    assert np.array_equal(picture, still.image(key))
    assert np.array_equal(mask, still.mask(key))
    assert np.array_equal(face, still.region_masks(key, ["face"])["face"])


def test_expressions_of_the_capture_look_as_there(moving):
    """Up to what folds and blood remember; another expression is far away."""
    truth = SyntheticTruth(moving)
    keys = [key for key in moving.splits["train"] if key.camera != FRONTAL]
    far = max(keys[1:], key=lambda key: -decibels(moving.image(key), moving.image(keys[0])))
    for key in (keys[0], far):
        seed = truth._plan.render_seed(key.sequence, key.timestep, key.camera)
        picture, mask, *_ = truth.render(moving.cameras[key.camera], moving.poses[key.timestep], seed)
        assert decibels(picture, moving.image(key)) > 37
        assert np.abs(mask.astype(int) - moving.mask(key)).mean() < 1.0
    assert decibels(moving.image(keys[0]), moving.image(far)) < 30


def test_what_it_stands_on_is_the_clips(still, truth):
    red = SyntheticTruth(replace(still, background=np.array([1.0, 0.0, 0.0])))
    red.__dict__["_renderer"] = truth._renderer  # which takes long to make, and knows no background
    picture, mask, *_ = red.render(still.cameras[FRONTAL], still.poses[0])
    assert (picture[mask == 0] == [255, 0, 0]).all()
    assert red.fingerprint != truth.fingerprint


def test_controls_follow_from_a_pose(geometry):
    rng = np.random.default_rng(2)
    controls = {name: float(rng.uniform(0, 1)) for name in EXPRESSION_CONTROLS} | {"mouth_right": 0.0}
    names = ["jaw_open", "jaw_side", "jaw_roll", "gaze_left", "gaze_up", "head_turn", "head_nod", "head_tilt"]
    others = dict.fromkeys(names, 0.3)
    others |= dict.fromkeys(("neck_turn", "neck_nod", "sway_x", "sway_y", "sway_z"), 0.1)
    pose = geometry.translation.pose({**controls, **others}, "900", None)
    found = geometry.translation.activations(pose)
    assert {name: found[name] for name in others} == pytest.approx(others, abs=1e-6)
    again = geometry.translation.pose(found, "900", None)
    assert np.allclose(again.expression, pose.expression, atol=1e-5)


def made_otherwise(clip, **changes):
    """A clip whose record of its making has other entries, or none."""
    step = clip.steps[0]
    made = {**step.parameters["synthetic"], **changes} if changes else {}
    return replace(
        clip, steps=(replace(step, parameters={**step.parameters, "synthetic": made}), *clip.steps[1:])
    )


def test_a_clip_without_a_truth_says_why(still):
    below = StepRecord("mask_below_neck", {}, "")
    for clip, reason in (
        (made_otherwise(still), "only a synthetic capture"),
        (made_otherwise(still, edition=2), "is of edition 2.*Make the capture again"),
        (made_otherwise(still, head="ict-facekit"), "procedural head"),
        (replace(still, head=replace(still.head, version="procedural2020")), "poses of procedural2020"),
        (replace(still, steps=(*still.steps, below)), "below the neck"),
    ):
        with pytest.raises(UnavailableError, match=reason):
            SyntheticTruth(clip)


def test_depth_is_that_of_the_posed_mesh(still, truth):
    camera, pose = still.cameras[FRONTAL], still.poses[0]
    depth = truth.depth(camera, pose)
    assert depth.shape == (camera.height, camera.width)
    (mesh,) = PosedSubject.of(still).meshes([pose])
    along = mesh @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    face = truth.render(camera, pose).face
    seen = depth[face & np.isfinite(depth)]
    assert seen.size
    assert along.min() - 1e-3 <= seen.min()
    assert seen.max() <= along.max()
    assert np.median(seen) < np.median(along)  # the front of the head
