"""What the public function refuses, and how it chooses its backend."""

from __future__ import annotations

import logging
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from headbench.bench.errors import UnavailableError
from headbench.bench.native.dispatch import Kernel
from headbench.methods.benchmarks.splats import SplatScene, cloud
from headbench.methods.splats import available_backends, cpu, cuda, rasterize

from .cases import backends, request_of
from .test_cuda import FakeGsplat

WIDTH, HEIGHT = 44, 29  # neither is a multiple of a tile's 16 pixels


def published(scene: SplatScene, near: float = 0.2) -> list[int]:
    """`preprocessCUDA` of diff-gaussian-rasterization 59f5f77, splat by splat, in float64 and its own order of steps."""
    fx, fy = float(scene.K[0, 0]), float(scene.K[1, 1])
    world = scene.viewmat.double().numpy()
    radii = []
    for mean, quat, scale in zip(*(part.double().numpy() for part in scene[:3]), strict=True):
        point = world[:3, :3] @ mean + world[:3, 3]
        if point[2] <= near:
            radii.append(0)
            continue
        r, x, y, z = quat
        rotation = Rotation.from_quat([x, y, z, r]).as_matrix()
        spread = rotation @ np.diag(scale**2) @ rotation.T
        limits = 1.3 * WIDTH / (2 * fx), 1.3 * HEIGHT / (2 * fy)
        slopes = [min(limit, max(-limit, point[i] / point[2])) for i, limit in enumerate(limits)]
        jacobian = np.array([[fx, 0, -fx * slopes[0]], [0, fy, -fy * slopes[1]]]) / point[2]
        flat = jacobian @ world[:3, :3] @ spread @ world[:3, :3].T @ jacobian.T + 0.3 * np.eye(2)
        determinant, middle = np.linalg.det(flat), 0.5 * np.trace(flat)
        if determinant == 0:
            radii.append(0)
            continue
        radius = math.ceil(3 * math.sqrt(middle + math.sqrt(max(0.1, middle * middle - determinant))))
        # ndc2Pix, then getRect with tiles of 16 pixels.
        device = 2 * fx * point[0] / (WIDTH * point[2]), 2 * fy * point[1] / (HEIGHT * point[2])
        tiles = 1
        for value, size in zip(device, (WIDTH, HEIGHT), strict=True):
            pixel, grid = ((value + 1) * size - 1) * 0.5, (size + 15) // 16
            first = min(grid, max(0, int((pixel - radius) / 16)))
            last = min(grid, max(0, int((pixel + radius + 15) / 16)))
            tiles *= last - first
        radii.append(radius if tiles else 0)
    return radii


def crowd() -> SplatScene:
    """Splats in and about the image, near and behind the camera, most too faint to be drawn."""
    scene = cloud(600, WIDTH, HEIGHT, seed=3)
    rng = torch.Generator().manual_seed(4)
    draws = torch.rand(600, 3, generator=rng)
    means = (draws - torch.tensor([0.5, 0.5, 0.1])) * torch.tensor([1.8, 1.8, 2.0])
    return scene._replace(
        means=means,
        scales=0.002 * torch.exp(1.5 * torch.randn(600, 3, generator=rng)),
        opacities=10 ** (-6 * torch.rand(600, generator=rng)),
        viewmat=torch.eye(4),
        K=torch.tensor([[40.0, 0, WIDTH / 2], [0, 40.0, HEIGHT / 2], [0, 0, 1]]),
    )


@pytest.mark.parametrize("backend", [*available_backends(), "gsplat"])
def test_radii_are_those_published(backend):
    scene = crowd()
    if backend == "gsplat":
        found = cuda.draw(FakeGsplat(), request_of(*scene[:9], near=0.2)).radii
    else:
        found = rasterize(*scene[:9], near=0.2, backend=backend).radii
    wanted = torch.tensor(published(scene))
    seen = wanted > 0
    assert 100 < seen.sum() < 500
    assert (scene.opacities[seen] < 1 / 255).sum() > 50, "many of them are too faint to be drawn"
    assert torch.equal(found > 0, seen)
    # Where rounding up falls on the other side in float32, by one.
    assert (found - wanted).abs().max() <= 1
    assert (found != wanted).float().mean() < 0.02


@backends
@pytest.mark.parametrize("antialiased", [False, True])
def test_opacity_does_not_change_radii(backend, antialiased):
    scene = crowd()
    options = {"backend": backend, "antialiased": antialiased}
    drawn = [
        rasterize(*scene._replace(opacities=torch.full((600,), opacity))[:9], **options)
        for opacity in (0.0, 1e-3, 1.0)
    ]
    assert not drawn[0].alpha.any()
    assert torch.equal(drawn[0].radii, drawn[1].radii)
    assert torch.equal(drawn[0].radii, drawn[2].radii)


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
