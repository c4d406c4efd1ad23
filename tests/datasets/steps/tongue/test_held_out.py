"""The whole detector on a synthetic subject that no constant was chosen on, with 1 mm of tracking error."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.datasets.ga.reader import read_capture
from headbench.datasets.steps.tongue.evidence import decide, find_evidence
from headbench.datasets.steps.tongue.mouth import facing_cameras, mouth_atlas, posed_meshes, sample_clip
from headbench.datasets.synthetic.capture import synthesize

ERROR_MM = 1.0


def with_tracking_error(clip, rms_mm, seed=0):
    """The clip with poses whose meshes are off by that much (RMS over the face's vertices and timesteps)."""
    timesteps = sorted(clip.poses)
    face = clip.head.regions["face"]
    exact = {t: vertices[face] for t, vertices in posed_meshes(clip, timesteps)}
    names = ("expression", "rotation", "neck", "jaw", "translation")

    def off(amount):
        rng = np.random.default_rng(seed)
        poses = dict(clip.poses)
        for name in names:
            values = np.stack([getattr(clip.poses[t], name) for t in timesteps])
            noisy = values + amount * values.std(axis=0) * rng.standard_normal(values.shape)
            poses = {t: replace(poses[t], **{name: row}) for t, row in zip(timesteps, noisy)}
        return replace(clip, poses=poses)

    def error(moved):
        squares = [((v[face] - exact[t]) ** 2).sum(axis=1).mean() for t, v in posed_meshes(moved, timesteps)]
        return 1e3 * float(np.sqrt(np.mean(squares)))

    amount = 0.1
    for _ in range(3):  # nearly linear in the amount
        amount *= rms_mm / error(off(amount))
    moved = off(amount)
    assert error(moved) == pytest.approx(rms_mm, rel=0.05)
    return moved


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_synthetic_subject_is_decided_as_labelled(tmp_path):
    (union,) = synthesize(tmp_path, cameras=2, timesteps=40, size=(96, 136), seed=50, workers=1)
    clip = read_capture(union)
    labelled = {key.timestep for key in clip.excluded}
    moved = with_tracking_error(clip, ERROR_MM)
    atlas = mouth_atlas(moved)
    cameras = facing_cameras(moved, atlas, 4)
    colours = sample_clip(moved, atlas, cameras)
    evidence = find_evidence(colours, atlas)
    decided = decide(dict.fromkeys(colours.timesteps, ""), evidence, tuple(cameras), None, {})
    assert labelled
    assert set(decided.reasons()) == labelled
