"""Single-frame overfit on a path-traced capture, adapted to each method: a wrong gradient anywhere prevents it."""

import pytest

from headbench.bench.runner import adaptation
from headbench.bench.runner.adaptation import MethodNeeds
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.specs import GA_LAYOUT
from headbench.datasets.synthetic.capture import synthesize
from headbench.methods.gbs.spec import GBS
from headbench.methods.gha.spec import GHA
from headbench.methods.insta.spec import INSTA

from .single_frame import psnr_by_heart

ENOUGH_DB = 35.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spec", "height", "iterations", "settings"),
    [(GBS, 136, 500, {}), (GHA, 138, 600, {"expression_noise": 0.0}), (INSTA, 136, 600, {})],
    ids=lambda value: getattr(value, "name", None),
)
def test_single_frame_overfit_of_a_path_traced_capture(tmp_path, spec, height, iterations, settings):
    (union,) = synthesize(tmp_path / "capture", cameras=2, timesteps=8, size=(96, height), workers=1)
    clip = read_capture(union)
    needs = MethodNeeds.of(spec)
    planned = adaptation.plan(clip, needs, GA_LAYOUT, {})
    if planned is not None:
        clip = adaptation.carry_out(planned, needs, tmp_path / "adapted", "adapting").clip
    assert spec is not GBS or clip.head.version == "procedural2020"
    key = clip.splits["train"][-1]
    psnr = psnr_by_heart(spec, clip, key, tmp_path / "avatar", iterations, **settings)
    assert psnr >= ENOUGH_DB
