"""The knobs that trade accuracy for speed: that their errors are the ones they claim."""

import math

import pytest
import torch

from headbench.bench.contracts import no_progress
from headbench.methods.splats import available_backends
from headbench.tests.benchmarks.splats import tradeoffs
from headbench.tests.benchmarks.splats.passes import draw, leaves
from headbench.tests.benchmarks.splats.scenes import cloud


def test_a_splats_contribution_is_the_light_it_sends():
    scene = cloud(12, 20, 18, seed=1, size=0.1)
    weights = tradeoffs.contributions(scene, "reference")
    # A channel for each splat, black behind: what a channel sums to is that splat's weights.
    own = scene._replace(colors=torch.eye(12), background=torch.zeros(12))
    image = draw(own, leaves(own), backend="reference").image
    torch.testing.assert_close(weights, image.sum((0, 1)).detach())
    assert weights.max() > 0


@pytest.mark.skipif("cpu" not in available_backends(), reason="the splat kernel is not installed")
def test_curves_begin_exact_and_errors_grow_with_what_is_left_out(monkeypatch):
    monkeypatch.setattr(tradeoffs, "QUICK_SCENE", (600, 48, 40))
    points = tradeoffs.measure(True, no_progress).data["points"]
    assert points[0]["knob"] == "exact"
    assert points[0]["mean_error"] == 0
    assert points[0]["psnr"] is None  # infinite, which JSON does not have
    for knob in ("keep by contribution", "drop below opacity"):
        curve = [point for point in points if point["knob"] == knob]
        assert len(curve) == 4
        assert [p["splats"] for p in curve] == sorted((p["splats"] for p in curve), reverse=True)
        errors = [point["mean_error"] for point in curve]
        assert errors == sorted(errors)
        assert errors[-1] > 0
    for knob in ("least alpha", "least transmittance"):
        curve = [point for point in points if point["knob"] == knob]
        assert len(curve) == 3
        assert {p["splats"] for p in curve} == {600}
        errors = [point["mean_error"] for point in curve]
        assert errors == sorted(errors)
        assert 0 < errors[0] < curve[0]["max_error"]
    half = points[-1]
    assert half["splats"] == 600
    assert 0 < half["mean_error"] < 2**-11, "rounding to 11 bits"
    bound = -20 * math.log10(half["mean_error"])
    assert bound - 12 < half["psnr"] <= bound, "a mean square is no less than the mean's square"
