"""Every numerical extreme of the renderer on every backend; faults are found."""

import math
from dataclasses import replace

import pytest
import torch

from headbench.methods.benchmarks import extremes
from headbench.methods.benchmarks.extremes import EXTREMES, try_extreme
from headbench.methods.splats import available_backends

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
