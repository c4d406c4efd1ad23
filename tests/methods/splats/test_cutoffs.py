"""The cut-offs that trade accuracy for speed: every backend draws what the definitions say."""

from __future__ import annotations

import pytest

from headbench.methods.benchmarks.splats import SplatScene, cloud
from headbench.methods.splats import cuda, rasterize

from .cases import backends, check_kernels, needs_kernel, request_of
from .dense import render_dense

CUT_OFFS = [
    {"alpha_min": 4 / 255},
    {"transmittance_min": 1e-2},
    {"alpha_min": 0.05, "transmittance_min": 0.3},
]
cut_offs = pytest.mark.parametrize("options", CUT_OFFS, ids=["alpha", "transmittance", "both"])


def thick() -> SplatScene:
    """Opaque enough that every cut-off shows."""
    return cloud(250, 45, 38, seed=40, size=0.1, opacity=1.0)


@cut_offs
@backends
def test_images_are_those_of_the_definition(backend, options):
    scene = thick()
    truth = render_dense(scene, **options)
    exact = render_dense(scene)
    result = rasterize(*scene[:9], background=scene.background, backend=backend, **options)
    assert (exact.image - truth.image).abs()[truth.safe].max() > 1e-3, "the cut-off changes nothing here"
    assert (result.image - truth.image).abs()[truth.safe].max() < 2e-5


@needs_kernel
@cut_offs
def test_gradients_agree_with_the_reference(options):
    check_kernels(thick(), 0.0, 1.0, **options)


def test_splats_fainter_than_the_cut_off_are_not_drawn():
    scene = thick()
    colors = scene.colors.clone().requires_grad_()
    rasterize(*scene[:4], colors, *scene[5:9], alpha_min=0.3).image.sum().backward()
    faint = scene.opacities < 0.3
    assert faint.any()
    assert not colors.grad[faint].any()
    assert colors.grad.any()


def test_cuda_refuses_what_gsplat_cannot_do(monkeypatch):
    request = request_of(*cloud(5, 8, 8)[:9], alpha_min=0.1)
    monkeypatch.setattr(cuda, "load", lambda: None)
    with pytest.raises(ValueError, match=r"alpha_min.*backend 'cuda'.*0\.1"):
        cuda.rasterize_cuda(request)
    assert not cuda.supports(request)
