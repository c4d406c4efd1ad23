"""Refined tracking: whom it answers to, and that refining helps."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.errors import InputError
from headbench.methods.ga.method import GA
from headbench.methods.ga.spec import GAConfig
from headbench.methods.shared.avatar_files import TRACKED, RefinedTracking, read_shared_head, save_shared_head
from headbench.methods.shared.config import SplatTraining


def tracking(clip):
    tracked = {
        name: np.stack([np.asarray(getattr(clip.poses[t], name), np.float32) for t in (0, 1)])
        for name in TRACKED
    }
    refined = {name: values + np.float32(1) for name, values in tracked.items()}
    return RefinedTracking("toy", np.array([0, 1]), tracked, refined)


def test_it_answers_to_its_own_signal_only(clip):
    refine = tracking(clip)
    pose = clip.poses[1]
    np.testing.assert_allclose(refine(pose).expression, pose.expression + 1, rtol=1e-6)
    changes = {"timestep": None}, {"subject": "other"}, {"timestep": 0}, {"jaw": pose.jaw + np.float32(1e-4)}
    for other in (clip.poses[2], *(replace(pose, **change) for change in changes)):
        assert refine(other) is other


def test_it_survives_the_disk(clip, tmp_path):
    refine = tracking(clip)
    refine.save(tmp_path / "driving.npz")
    again = RefinedTracking.read(tmp_path / "driving.npz")
    one, other = refine(clip.poses[0]), again(clip.poses[0])
    for name in TRACKED:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.savez(tmp_path / "short.npz", subject=np.array("toy"))
    with pytest.raises(InputError, match="timesteps"):
        RefinedTracking.read(tmp_path / "short.npz")


@pytest.mark.parametrize(
    ("key", "change"),
    [
        ("timesteps", lambda values: values.astype(float)),
        ("tracked_neck", lambda values: values[:, 0]),
        ("refined_expression", lambda values: values[:, :-1]),
        ("refined_translation", lambda values: values * np.float32(np.nan)),
        ("refined_jaw", lambda values: values.astype(np.float64)),
    ],
)
def test_tracking_that_does_not_fit_is_refused(clip, tmp_path, key, change):
    path = tmp_path / "driving.npz"
    tracking(clip).save(path)
    arrays = dict(np.load(path))
    np.savez(path, **{**arrays, key: change(arrays[key])})
    with pytest.raises(InputError, match=key):
        RefinedTracking.read(path)


def test_the_head_model_beside_an_avatar_is_the_clips(head, tmp_path):
    save_shared_head(tmp_path, head)
    found = read_shared_head(tmp_path)
    assert found.version == head.version
    np.testing.assert_array_equal(found.expression_basis, head.expression_basis)
    np.testing.assert_array_equal(found.regions["face"], head.regions["face"])


def test_refining_moves_wrong_tracking_towards_the_truth(clip, tmp_path):
    # Timestep 1 alone is tracked 8 mm off; the others fix what the head looks like.
    shift = np.array([0.008, 0, 0], np.float32)
    wrong = {t: replace(p, translation=p.translation + shift * (t == 1)) for t, p in clip.poses.items()}
    splats = SplatTraining(position_lr=1e-4, position_lr_final=1e-5, max_splats=600)
    config = GAConfig(splats=splats, translation_lr=5e-4, pose_lr=0.0, expression_lr=0.0)
    budget, options = Budget(iterations=200), {"device": "cpu", "seed": 0, "progress": no_progress}
    GA(config).fit(replace(clip, poses=wrong), tmp_path, budget, **options)
    refine = RefinedTracking.read(tmp_path / "driving.npz")
    off = {t: refine(wrong[t]).translation - clip.poses[t].translation for t in (0, 1, 2)}
    # Splats may shift against the mesh as a whole, so only the difference between timesteps means something.
    assert np.linalg.norm(off[1] - 0.5 * (off[0] + off[2])) < 0.2 * np.linalg.norm(shift)


def test_tracking_left_alone_leaves_no_driving_file(clip, tmp_path):
    config = GAConfig(refine_tracking=False)
    GA(config).fit(clip, tmp_path, Budget(iterations=2), device="cpu", seed=0, progress=no_progress)
    assert not (tmp_path / "driving.npz").exists()
