"""What the renderer's tests share: the kernels of this machine, requests with the usual options, outcomes to compare."""

from __future__ import annotations

from typing import NamedTuple

import pytest
import torch

from headbench.methods.benchmarks.splats import DrawnScene, SplatScene, relative_error, render_with_gradients
from headbench.methods.splats import available_backends
from headbench.methods.splats.request import Request, make_request

from .dense import render_dense

KERNELS = [name for name in available_backends() if name.startswith("cpu-")]
needs_kernel = pytest.mark.skipif(
    not KERNELS, reason="the splat kernel is not installed: no C++ compiler was found"
)
kernels = pytest.mark.parametrize("kernel", KERNELS)
backends = pytest.mark.parametrize("backend", available_backends())
USUAL = {"near": 0.01, "far": 1e10, "eps2d": 0.3, "antialiased": False, "background": None}
COLLECTORS = {"means2d_offset": None, "check_values": True}


def request_of(*scene, **options) -> Request:
    """The request of `rasterize` with these arguments."""
    return make_request(*scene, **{**USUAL, **COLLECTORS, **options})


def check_kernels(scene: SplatScene, least_safe: float = 0.5, loosely: float = 0.05, **options) -> None:
    """Image, alpha, radii and gradients of every kernel are those of the reference in float64.

    Where an alpha lies on a threshold, float32 may take the other side: such pixels are compared loosely, and kept out
    of the gradients.
    """
    safe = render_dense(scene, **options).safe
    assert safe.float().mean() > least_safe
    truth = render_with_gradients(scene, torch.float64, weights=safe.double(), backend="reference", **options)
    assert truth.rendering.alpha.max() > 0.1, "an empty image would prove nothing"
    for kernel in KERNELS:
        result = render_with_gradients(scene, torch.float32, weights=safe.float(), backend=kernel, **options)
        for field in ("image", "alpha"):
            error = (getattr(result.rendering, field) - getattr(truth.rendering, field)).abs()
            assert error[safe].max() < 2e-5, (kernel, field)
            assert error.max() < loosely, (kernel, field)
        assert result.rendering.radii.dtype == torch.int32
        wrong = result.rendering.radii - truth.rendering.radii
        assert wrong.abs().max() <= 1, "radii may differ where rounding up falls on the other side, by one"
        assert (wrong != 0).float().mean() < 0.02
        for field, gradient in truth.gradients.items():
            assert result.gradients[field].dtype == torch.float32
            assert relative_error(result.gradients[field], gradient) < 1e-4, (kernel, field)


class Accuracy(NamedTuple):
    """Errors of a kernel against float64, all pixels and all splats counted."""

    image_mean: float
    image_max: float
    pixels_equal: float
    """Share of pixels within 1e-5 of the truth in every channel."""
    gradients: dict[str, float]
    """Norm of the error over the norm of the truth, by input."""


def float64_truth(scene: SplatScene) -> DrawnScene:
    """Draw and differentiate with the reference in float64: about 25 s and 1.7 GB for 60 000 splats at 550x802."""
    return render_with_gradients(scene, torch.float64, backend="reference")


def compare_with(truth: DrawnScene, scene: SplatScene, backend: str) -> Accuracy:
    """A backend in float32 on one thread against the `float64_truth` of the same scene."""
    result = render_with_gradients(scene, torch.float32, backend=backend, threads=1)
    error = (result.rendering.image.double() - truth.rendering.image).abs()
    equal = float((error.amax(-1) <= 1e-5).double().mean())
    errors = {name: relative_error(result.gradients[name], value) for name, value in truth.gradients.items()}
    return Accuracy(float(error.mean()), float(error.max()), equal, errors)
