"""What the public function refuses, and how it chooses its backend."""

from __future__ import annotations

import logging

import pytest
import torch

from headbench.bench.errors import UnavailableError
from headbench.bench.native.loader import Kernel
from headbench.methods.benchmarks.scenes import (
    SplatScene,
    cloud,
)
from headbench.methods.splats import available_backends, cpu, rasterize

from .cases import backends

BAD = [
    ("means", torch.zeros(5, 2), r"means: expected shape \(5, 3\)"),
    ("means", torch.zeros(5, 3, dtype=torch.int64), "means: .*int64"),
    ("quats", torch.zeros(4, 4), r"quats: expected shape \(5, 4\).*found shape \(4, 4\)"),
    ("scales", torch.zeros(5, 3, dtype=torch.float64), "scales: expected dtype torch.float32.*float64"),
    ("opacities", torch.zeros(5, 1), r"opacities: expected shape \(5,\)"),
    ("opacities", [0.0] * 5, "opacities: .*torch tensor.*list"),
    ("colors", torch.zeros(5), "colors"),
    ("colors", torch.zeros(2, 5, 3), "colors"),
    ("viewmat", torch.eye(4).expand(2, 4, 4), "viewmat"),
    ("colors", torch.zeros(5, 33), "colors: .*1 to 32"),
    ("colors", torch.zeros(5, 0), "colors"),
    ("viewmat", torch.eye(3), r"viewmat: expected shape \(4, 4\)"),
    ("K", torch.eye(4), r"K: expected shape \(3, 3\)"),
    ("width", 0, "width: expected a positive integer"),
    ("width", 10.0, "width: expected a positive integer"),
    ("height", -3, "height: expected a positive integer"),
    ("background", torch.zeros(2, 3), r"background: expected shape \(3,\)"),
]


@pytest.mark.parametrize(("name", "value", "message"), BAD)
def test_wrong_arguments_are_named(name, value, message):
    scene = cloud(5, 8, 8)._replace(**{name: value})
    with pytest.raises(ValueError, match=message):
        rasterize(*scene[:9], background=scene.background)


def with_value(field, index, value):
    scene = cloud(5, 8, 8)
    bad = getattr(scene, field).clone()
    bad.view(-1)[index] = value
    return scene._replace(**{field: bad})


@backends
@pytest.mark.parametrize("name", [*SplatScene._fields[:7], "background"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_values_that_are_not_finite_are_refused(backend, name, value):
    scene = with_value(name, -1, value)
    with pytest.raises(ValueError, match=rf"{name}: expected finite values, found 1 that are not"):
        rasterize(*scene[:9], background=scene.background, backend=backend)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("scales", -1e-6, r"scales: .* >= 0, found 1 outside, the first -1e-06 at index \(0, 0\)"),
        ("opacities", 1.001, r"opacities: expected values in \[0, 1\], found 1 outside, the first 1.001"),
        ("opacities", -0.001, r"opacities: expected values in \[0, 1\]"),
        ("K", -10.0, r"K: expected focal lengths > 0, found 1 outside, the first -10"),
        ("K", 0.0, r"K: expected focal lengths > 0"),
    ],
)
def test_values_outside_of_their_range_are_refused(field, value, message):
    scene = with_value(field, 0, value)
    with pytest.raises(ValueError, match=message):
        rasterize(*scene[:9])
    assert torch.isfinite(rasterize(*scene[:9], check_values=False).alpha).all() or field == "K"


def test_the_ends_of_ranges_are_accepted():
    scene = cloud(5, 8, 8)
    scene.scales[0], scene.opacities[0], scene.opacities[1] = 0.0, 0.0, 1.0
    assert torch.isfinite(rasterize(*scene[:9]).image).all()
    assert rasterize(*cloud(0, 8, 8)[:9]).radii.shape == (0,)


def test_large_finite_values_are_not_mistaken_for_infinite():
    scene = cloud(5, 8, 8)
    scene.means[:] = 3e38  # their sum overflows
    assert not rasterize(*scene[:9]).alpha.any()


@backends
def test_unchecked_geometry_that_is_not_finite_is_culled(backend):
    scene = cloud(40, 20, 20, seed=1, size=0.1)
    for index, field in enumerate(("means", "quats", "scales", "opacities")):
        getattr(scene, field)[index] = float("nan")
    result = rasterize(*scene[:9], backend=backend, check_values=False)
    assert result.radii[:3].tolist() == [0] * 3, "opacity plays no part in these"
    without = rasterize(*[value[4:] for value in scene[:5]], *scene[5:9], backend=backend)
    assert torch.equal(result.image, without.image)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"near": 0.0}, "near, far"),
        ({"near": 2.0, "far": 1.0}, "near, far"),
        ({"eps2d": -0.1}, "eps2d"),
        ({"eps2d": float("inf")}, "eps2d"),
        ({"means2d_offset": torch.zeros(5, 3)}, r"means2d_offset: expected shape \(5, 2\)"),
        ({"backend": "gpu"}, "backend: expected one of 'auto'"),
        ({"backend": "cpu", "threads": 0}, "threads: expected a positive integer"),
    ],
)
def test_wrong_options_are_named(options, message):
    if options.get("threads") == 0 and "cpu" not in available_backends():
        pytest.skip("the splat kernel is not installed: no C++ compiler was found")
    with pytest.raises(ValueError, match=message):
        rasterize(*cloud(5, 8, 8)[:9], **options)


@backends
def test_near_far_and_low_pass_are_parameters(backend):
    scene = cloud(1, 15, 15)._replace(
        means=torch.tensor([[0.0, 0.0, 1.0]]), viewmat=torch.eye(4), opacities=torch.tensor([0.9])
    )
    assert rasterize(*scene[:9], backend=backend).alpha.any()
    assert not rasterize(*scene[:9], near=1.1, backend=backend).alpha.any()
    assert not rasterize(*scene[:9], far=0.9, backend=backend).alpha.any()
    sharp, soft = (rasterize(*scene[:9], eps2d=eps, backend=backend) for eps in (0.01, 30.0))
    assert (sharp.alpha > 0).sum() < (soft.alpha > 0).sum()


def test_cameras_may_be_numpy_and_of_another_precision():
    scene = cloud(30, 12, 12)
    one = rasterize(*scene[:9])
    two = rasterize(*scene[:5], scene.viewmat.double().numpy(), scene.K.double().numpy(), 12, 12)
    assert torch.equal(one.image, two.image)


def test_double_precision_goes_to_the_reference():
    scene = cloud(10, 9, 9)
    inputs = [value.double() for value in scene[:7]]
    auto, reference = (rasterize(*inputs, 9, 9, backend=backend) for backend in ("auto", "reference"))
    assert auto.image.dtype == torch.float64
    assert torch.equal(auto.image, reference.image)
    if "cpu" in available_backends():
        with pytest.raises(ValueError, match="float32 on the CPU.*float64"):
            rasterize(*inputs, 9, 9, backend="cpu")


@pytest.fixture
def without_kernel(monkeypatch):
    """A kernel that cannot be imported, as on a machine without a compiler."""
    missing = Kernel("headbench.no_such_kernel", "The kernel", "the reference works meanwhile")
    monkeypatch.setattr(cpu, "KERNEL", missing)
    return missing


def test_without_the_kernel_the_reference_draws_and_warns_once(caplog, without_kernel):
    scene = cloud(10, 9, 9)
    assert available_backends() == ("reference",)
    with caplog.at_level(logging.WARNING):
        images = [rasterize(*scene[:9]).image for _ in range(2)]
    assert torch.equal(images[0], rasterize(*scene[:9], backend="reference").image)
    (message,) = (record.message for record in caplog.records)
    assert message.startswith("The kernel cannot be used (")
    assert message.endswith(without_kernel.remedy)
    with pytest.raises(UnavailableError, match="no_such_kernel.*compiler"):
        rasterize(*scene[:9], backend="cpu")
