"""Radii: what is in view, as the rasteriser published with 3D Gaussian Splatting has it, with every backend."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from headbench.methods.benchmarks.splats import SplatScene, cloud
from headbench.methods.splats import available_backends, cuda, rasterize

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
