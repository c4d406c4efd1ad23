"""What the public function refuses, and how it chooses its backend."""

from __future__ import annotations

import logging

import pytest
import torch

from headbench.bench.errors import UnavailableError
from headbench.bench.native.loader import Kernel
from headbench.methods.benchmarks.splats import SplatScene, cloud
from headbench.methods.splats import available_backends, cpu, rasterize

from .cases import backends

BAD = [
    ("means", torch.zeros(5, 2)),
    ("means", torch.zeros(5, 3, dtype=torch.int64)),
    ("quats", torch.zeros(4, 4)),
    ("scales", torch.zeros(5, 3, dtype=torch.float64)),
    *(("opacities", wrong) for wrong in (torch.zeros(5, 1), [0.0] * 5)),
    *(("colors", torch.zeros(shape)) for shape in ((5,), (2, 5, 3), (5, 33), (5, 0))),
    *(("viewmat", wrong) for wrong in (torch.eye(4).expand(2, 4, 4), torch.eye(3))),
    ("K", torch.eye(4)),
    *(("width", wrong) for wrong in (0, 10.0)),
    ("height", -3),
    ("background", torch.zeros(2, 3)),
    *(("near", wrong) for wrong in (0.0, 1e11)),
    *(("eps2d", wrong) for wrong in (-0.1, float("inf"))),
    ("means2d_offset", torch.zeros(5, 3)),
    ("backend", "gpu"),
    *(("alpha_min", wrong) for wrong in (0.0, 1.0, float("nan"))),
    *(("transmittance_min", wrong) for wrong in (0.0, 1.0)),
]


@pytest.mark.parametrize(("name", "value"), BAD)
def test_wrong_arguments_are_named(name, value):
    scene, options = cloud(5, 8, 8), {}
    if name in scene._fields:
        scene = scene._replace(**{name: value})
    else:
        options[name] = value
    with pytest.raises(ValueError, match=name):
        rasterize(*scene[:9], background=scene.background, **options)


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


OUTSIDE = [("scales", -1e-6), ("opacities", 1.001), ("opacities", -0.001), ("K", -10.0), ("K", 0.0)]


@pytest.mark.parametrize(("field", "value"), OUTSIDE)
def test_values_outside_of_their_range_are_refused(field, value):
    scene = with_value(field, 0, value)
    with pytest.raises(ValueError, match=rf"{field}: expected .*found 1 outside"):
        rasterize(*scene[:9])
    assert torch.isfinite(rasterize(*scene[:9], check_values=False).alpha).all() or field == "K"


@backends
def test_unchecked_geometry_that_is_not_finite_is_culled(backend):
    scene = cloud(40, 20, 20, seed=1, size=0.1)
    for index, field in enumerate(("means", "quats", "scales", "opacities")):
        getattr(scene, field)[index] = float("nan")
    result = rasterize(*scene[:9], backend=backend, check_values=False)
    assert result.radii[:3].tolist() == [0] * 3, "opacity plays no part in these"
    without = rasterize(*[value[4:] for value in scene[:5]], *scene[5:9], backend=backend)
    assert torch.equal(result.image, without.image)


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
