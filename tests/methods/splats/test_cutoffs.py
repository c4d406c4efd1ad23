"""The cut-offs that trade accuracy for speed: every backend draws what the definitions say."""

from __future__ import annotations

import pytest
import torch

from headbench.methods.splats import available_backends, cuda, rasterize
from headbench.methods.splats.rasterize import make_request
from headbench.tests.benchmarks.splats.scenes import Scene, cloud, relative_error, render_with_gradients

from .dense import render_dense

CUT_OFFS = [
    {"alpha_min": 4 / 255},
    {"transmittance_min": 1e-2},
    {"alpha_min": 0.05, "transmittance_min": 0.3},
]
cut_offs = pytest.mark.parametrize("options", CUT_OFFS, ids=["alpha", "transmittance", "both"])


def thick() -> Scene:
    """Opaque enough that every cut-off shows."""
    return cloud(250, 45, 38, seed=40, size=0.1, opacity=1.0)


@cut_offs
@pytest.mark.parametrize("backend", available_backends())
def test_images_are_those_of_the_definition(backend, options):
    scene = thick()
    truth = render_dense(scene, **options)
    exact = render_dense(scene)
    result = rasterize(*scene[:9], background=scene.background, backend=backend, **options)
    assert (exact.image - truth.image).abs()[truth.safe].max() > 1e-3, "the cut-off changes nothing here"
    assert (result.image - truth.image).abs()[truth.safe].max() < 2e-5


@cut_offs
@pytest.mark.parametrize("kernel", [name for name in available_backends() if name.startswith("cpu-")])
def test_gradients_agree_with_the_reference(kernel, options):
    scene = thick()
    safe = render_dense(scene, **options).safe
    truth = render_with_gradients(scene, torch.float64, weights=safe.double(), backend="reference", **options)
    result = render_with_gradients(scene, torch.float32, weights=safe.float(), backend=kernel, **options)
    for name, gradient in truth.gradients.items():
        assert relative_error(result.gradients[name], gradient) < 1e-4, name
    assert ((result.rendering.radii - truth.rendering.radii).abs() <= 1).all()


def test_splats_fainter_than_the_cut_off_are_not_drawn():
    scene = thick()
    colors = scene.colors.clone().requires_grad_()
    rasterize(*scene[:4], colors, *scene[5:9], alpha_min=0.3).image.sum().backward()
    faint = scene.opacities < 0.3
    assert faint.any()
    assert not colors.grad[faint].any()
    assert colors.grad.any()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("alpha_min", 0.0),
        ("alpha_min", 1.0),
        ("alpha_min", float("nan")),
        ("transmittance_min", 0.0),
        ("transmittance_min", 1.0),
    ],
)
def test_cut_offs_that_make_no_sense_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name}: expected a number from"):
        rasterize(*cloud(5, 8, 8)[:9], **{name: value})


def test_cuda_refuses_what_gsplat_cannot_do(monkeypatch):
    scene = cloud(5, 8, 8)
    common = {"near": 0.01, "far": 1e10, "eps2d": 0.3, "antialiased": False, "means2d_offset": None}
    request = make_request(
        *scene[:9],
        background=None,
        means2d_abs=None,
        check_values=True,
        mask_non_finite=False,
        alpha_min=0.1,
        **common,
    )
    monkeypatch.setattr(cuda, "load", lambda: None)
    with pytest.raises(ValueError, match=r"alpha_min.*backend 'cuda'.*0\.1"):
        cuda.rasterize_cuda(request)
    assert not cuda.supports(request)
