"""INSTA learns a path-traced frame by heart at its demo preset: a wrong or missing gradient anywhere keeps it from that."""

import pytest

from headbench.datasets.ga.reader import read_capture
from headbench.datasets.synthetic.capture import synthesize
from headbench.methods.insta.spec import INSTA

from ..single_frame import psnr_by_heart

ENOUGH_DB = 35.0


@pytest.mark.slow
def test_one_path_traced_frame_is_learnt_by_heart(tmp_path):
    (union,) = synthesize(tmp_path / "capture", cameras=2, timesteps=8, size=(96, 136), workers=1)
    clip = read_capture(union)
    psnr = psnr_by_heart(INSTA, clip, clip.splits["train"][-1], tmp_path / "avatar", 600)
    assert psnr >= ENOUGH_DB
