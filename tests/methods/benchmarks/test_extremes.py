"""Every numerical extreme of the renderer on every backend; faults are found."""

import math
from dataclasses import replace

import pytest
import torch

from headbench.methods.benchmarks import extremes
from headbench.methods.benchmarks.extremes import EXTREMES, facing, poisoned, try_extreme
from headbench.methods.splats import available_backends, rasterize

backends = pytest.mark.parametrize("backend", [name for name in available_backends() if name != "cpu"])


@backends
@pytest.mark.parametrize("case", EXTREMES, ids=lambda case: case.name)
def test_extreme(case, backend):
    row = try_extreme(case, backend)
    assert row["verdict"] == "ok"
    assert math.isfinite(row["image error"])


@backends
def test_values_that_are_not_finite(backend):
    assert {name: text for name, text in extremes.special_cases(backend).items() if text} == {}


def test_masked_splats_are_counted_in_batches_too():
    scene = poisoned(float("nan"))
    views = torch.stack([scene.viewmat, scene.viewmat])
    colors = torch.stack([torch.zeros_like(scene.colors), scene.colors])
    result = rasterize(*scene[:4], colors, views, *scene[6:9], mask_non_finite=True)
    assert result.masked == 5
    assert torch.isfinite(result.image).all()
    assert (result.radii[:, :5] == 0).all()


def test_a_camera_not_finite_is_refused_even_with_masked_splats():
    scene = facing(3)
    with pytest.raises(ValueError, match="viewmat: expected finite"):
        rasterize(*scene[:5], torch.full((4, 4), float("nan")), *scene[6:9], mask_non_finite=True)


def _spoilt(field, change):
    """`render_with_gradients` whose float32 outcomes are changed."""
    genuine = extremes.render_with_gradients

    def render(scene, dtype, **options):
        outcome = genuine(scene, dtype, **options)
        if dtype == torch.float64:
            return outcome
        if field == "image":
            image = change(outcome.rendering.image)
            return outcome._replace(rendering=replace(outcome.rendering, image=image))
        return outcome._replace(gradients={**outcome.gradients, field: change(outcome.gradients[field])})

    return render


@pytest.mark.parametrize(
    ("field", "change", "complaint"),
    [
        ("image", lambda v: v + 1e-5, "image error"),
        ("image", lambda v: torch.where(v > v.median(), v, v + 1.0), "image error"),
        ("image", lambda v: v.log(), "not finite"),
        ("quats", lambda v: 1.01 * v, "gradient error of quats"),
        ("scales", lambda v: v / 0, "gradients of scales are not finite"),
    ],
)
def test_a_fault_is_seen(monkeypatch, field, change, complaint):
    monkeypatch.setattr(extremes, "render_with_gradients", _spoilt(field, change))
    case = next(case for case in EXTREMES if case.name == "equal depths")
    assert complaint in try_extreme(case, "reference")["verdict"]
