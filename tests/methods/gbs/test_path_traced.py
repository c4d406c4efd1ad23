"""From a path-traced capture to an avatar, by way of the refit and the single video."""

import pytest

from headbench.bench.runner import adaptation
from headbench.bench.runner.adaptation import MethodNeeds
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.specs import GA_LAYOUT
from headbench.datasets.synthetic.capture import synthesize
from headbench.methods.gbs.spec import GBS

from ..single_frame import psnr_by_heart

ENOUGH_DB = 35.0


@pytest.mark.slow
def test_one_path_traced_frame_is_learnt_by_heart(tmp_path):
    (union,) = synthesize(tmp_path / "capture", cameras=2, timesteps=8, size=(96, 136), workers=1)
    needs = MethodNeeds.of(GBS)
    planned = adaptation.plan(read_capture(union), needs, GA_LAYOUT, {})
    assert planned is not None
    clip = adaptation.carry_out(planned, needs, tmp_path / "adapted", "adapting").clip
    assert clip.head.version == "procedural2020"
    psnr = psnr_by_heart(GBS, clip, clip.splits["train"][-1], tmp_path / "avatar", 500)
    assert psnr >= ENOUGH_DB
