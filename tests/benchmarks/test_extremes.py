"""Every numerical extreme of the renderer on every backend, and of the head model; faults are found."""

import math
from dataclasses import replace

import pytest
import torch

from headbench.bench.contracts import no_progress
from headbench.datasets.head.model import FastPosing
from headbench.datasets.head.rotations import axis_angle_to_matrix
from headbench.methods.splats import available_backends
from headbench.tests.benchmarks.head import stress as head_stress
from headbench.tests.benchmarks.splats import stress
from headbench.tests.benchmarks.splats.extremes import CASES

from ..datasets.head.toy import toy_head

HEAD = toy_head(16, eyelids=True)
BACKENDS = [name for name in available_backends() if name != "cpu"]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_extreme(case, backend):
    verdict = stress.try_case(case, backend)
    assert verdict.complaint == ""
    assert verdict.image_error is not None
    assert math.isfinite(verdict.image_error)


@pytest.mark.parametrize("backend", BACKENDS)
def test_values_that_are_not_finite(backend):
    verdicts = [*stress.non_finite(backend), stress.try_upstream(backend), stress.try_threads(backend)]
    assert [verdict.case for verdict in verdicts if verdict.complaint] == []


def test_masked_splats_are_counted_in_batches_too():
    scene = stress._poisoned(float("nan"))
    views = torch.stack([scene.viewmat, scene.viewmat])
    colors = torch.stack([torch.zeros_like(scene.colors), scene.colors])
    result = stress.rasterize(*scene[:4], colors, views, *scene[6:9], mask_non_finite=True)
    assert result.masked == 5
    assert torch.isfinite(result.image).all()
    assert (result.radii[:, :5] == 0).all()


def test_a_camera_not_finite_is_refused_even_with_masked_splats():
    scene = stress.facing(3)
    with pytest.raises(ValueError, match="viewmat: expected finite"):
        stress.rasterize(*scene[:5], torch.full((4, 4), float("nan")), *scene[6:9], mask_non_finite=True)


def _spoilt(field, change):
    """`render_with_gradients` whose float32 outcomes are changed."""
    genuine = stress.render_with_gradients

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
    monkeypatch.setattr(stress, "render_with_gradients", _spoilt(field, change))
    case = next(case for case in CASES if case.name == "equal depths")
    assert complaint in stress.try_case(case, "reference").complaint


@pytest.mark.parametrize("case", head_stress.CASES, ids=lambda case: case.name)
def test_extreme_of_the_head_model(case):
    verdict = head_stress.try_case(case, HEAD)
    assert verdict.complaint == ""


@pytest.mark.slow
def test_the_whole_head_command_passes():
    findings = head_stress.measure(False, no_progress)
    assert findings.passed
    assert len(findings.data["verdicts"]) == len(head_stress.CASES)


def test_a_wrong_fast_path_is_found(monkeypatch):
    right = FastPosing.forward
    monkeypatch.setattr(FastPosing, "forward", lambda *a: right(*a) + 1e-9)
    assert head_stress.try_case(head_stress.CASES[0], HEAD).complaint == "the paths differ"


def test_gradients_that_are_not_finite_are_found(monkeypatch):
    def careless(axis_angle):
        """The right matrices; the root of the squared angle has no finite gradient at zero."""
        return axis_angle_to_matrix(axis_angle) + 0 * axis_angle.square().sum(-1).sqrt()[..., None, None]

    monkeypatch.setattr("headbench.datasets.head.model.axis_angle_to_matrix", careless)
    assert head_stress.try_case(head_stress.CASES[0], HEAD).complaint == "not finite"
