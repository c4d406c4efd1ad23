"""Each splat method can learn one frame by heart: a wrong or missing gradient anywhere keeps it from that."""

import pytest

from headbench.methods.ga.spec import GA
from headbench.methods.gbs.spec import GBS
from headbench.methods.ours.spec import OURS

from .single_frame import psnr_by_heart

ITERATIONS = 500
ENOUGH_DB = 45.0
OVER = {
    "ours": {"sampling": {"balanced": False}},  # one timestep has no clusters
    "gbs": {"sample_spacing": 0.5},  # the toy's texture changes from triangle to triangle
}


@pytest.mark.slow
@pytest.mark.parametrize("spec", [GA, GBS, OURS], ids=lambda spec: spec.name)
def test_one_frame_is_learnt_by_heart(clip, tmp_path, spec):
    settings = OVER.get(spec.name, {})
    psnr = psnr_by_heart(spec, clip, clip.splits["train"][0], tmp_path, ITERATIONS, **settings)
    assert psnr >= ENOUGH_DB
