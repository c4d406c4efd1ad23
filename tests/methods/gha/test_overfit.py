"""GHA learns a path-traced frame by heart at its demo preset: a wrong or missing gradient anywhere keeps it from that."""

import pytest

from headbench.datasets.ga.reader import read_capture
from headbench.datasets.synthetic.capture import synthesize
from headbench.methods.gha.spec import GHA

from ..single_frame import psnr_by_heart
from ..toy_clip import ToyClip

ENOUGH_DB = 35.0


@pytest.mark.slow
def test_one_path_traced_frame_is_learnt_by_heart(tmp_path):
    (union,) = synthesize(
        tmp_path / "capture", cameras=2, timesteps=8, size=(96, 138), samples_per_pixel=16, workers=2
    )
    whole = read_capture(union)
    key = whole.splits["train"][0]
    clip = ToyClip(
        *(whole.head, whole.shape, whole.static_offset, whole.cameras, whole.poses),
        splits={"train": (key,), "novel_view": (), "self_reenactment": ()},
        images={key: whole.image(key)},
        masks={key: whole.mask(key)},
        background=whole.background,
        subject=whole.subject,
    )
    psnr = psnr_by_heart(GHA, clip, key, tmp_path / "avatar", 600, expression_noise=0.0)
    assert psnr >= ENOUGH_DB
