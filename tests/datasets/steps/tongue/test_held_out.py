"""The whole detector on a synthetic subject that no constant was chosen on."""

import pytest

from headbench.datasets.ga.reader import read_capture
from headbench.datasets.steps.tongue.evidence import decide, find_evidence
from headbench.datasets.steps.tongue.mouth import facing_cameras, mouth_atlas, sample_clip
from headbench.datasets.synthetic.capture import synthesize


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_synthetic_subject_is_decided_as_labelled(tmp_path):
    (union,) = synthesize(tmp_path, cameras=2, timesteps=40, size=(96, 136), seed=50, workers=1)
    clip = read_capture(union)
    labelled = {key.timestep for key in clip.excluded}
    atlas = mouth_atlas(clip)
    cameras = facing_cameras(clip, atlas, 4)
    colours = sample_clip(clip, atlas, cameras)
    evidence = find_evidence(colours, atlas)
    decided = decide(dict.fromkeys(colours.timesteps, ""), evidence, tuple(cameras), None, {})
    assert labelled
    assert set(decided.reasons()) == labelled
