"""How exact the kernel is on whole frames of a head's load, no pixel left out: the floors that the project holds."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from headbench.methods.splats import available_backends
from headbench.tests.benchmarks.splats.scenes import (
    Outcome,
    Scene,
    cloud,
    compare_with,
    float64_truth,
    head_shell,
)

KERNELS = [name for name in available_backends() if name.startswith("cpu-")]
pytestmark = pytest.mark.skipif(
    not KERNELS, reason="the splat kernel is not installed: no C++ compiler was found"
)
kernels = pytest.mark.parametrize("kernel", KERNELS)


@pytest.fixture(scope="module", autouse=True)
def one_torch_thread() -> Iterator[None]:
    """More threads cost the reference more processor time than they save."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def middle() -> tuple[Scene, Outcome]:
    scene = head_shell(20_000, 275, 401)
    return scene, float64_truth(scene)


@pytest.fixture(scope="module")
def large() -> tuple[Scene, Outcome]:
    scene = head_shell(60_000, 550, 802)
    return scene, float64_truth(scene)


def check_floors(scene: Scene, truth: Outcome, kernel: str) -> None:
    """Floors for any scene. Where an alpha lies on a threshold a pixel may fall on the other side: few may."""
    accuracy = compare_with(truth, scene, kernel)
    assert accuracy.image_mean <= 1e-6
    assert accuracy.pixels_equal >= 0.9999
    for name, error in accuracy.gradients.items():
        assert error <= (2e-4 if name == "quats" else 1e-4), name


@kernels
def test_a_frame_of_20_000_splats_is_exact(kernel, middle):
    check_floors(*middle, kernel)


@pytest.mark.slow
@kernels
def test_a_frame_of_60_000_splats_is_exact(kernel, large):
    check_floors(*large, kernel)


@kernels
def test_depths_that_float32_cannot_tell_apart_keep_their_order(kernel):
    """Behind the origin of the world by nanometres, seen from a metre: equal to float32, and yet one is in front."""
    count = 200
    scene = cloud(count, 32, 24, seed=3, size=0.2, opacity=1.0)
    means = scene.means.clone()
    means[:, 2] = 1e-9 * torch.randperm(count, generator=torch.Generator().manual_seed(4))
    viewmat = torch.eye(4)
    viewmat[2, 3] = 1.0
    scene = scene._replace(means=means, viewmat=viewmat)
    assert len((means[:, 2] + viewmat[2, 3]).unique()) < 10
    accuracy = compare_with(float64_truth(scene), scene, kernel)
    assert accuracy.image_max < 1e-5
    assert max(accuracy.gradients.values()) < 1e-4


@pytest.fixture(scope="module")
def wide() -> tuple[Scene, Outcome]:
    """Splats a pixel wide at the right end of a wide image."""
    width, height, count = 2048, 16, 300
    rng = torch.Generator().manual_seed(6)
    means = torch.rand(count, 3, generator=rng) * torch.tensor([0.006, 0.008, 0.5]) + torch.tensor(
        [0.99, 0, 1]
    )
    means[:, :2] *= means[:, 2:]
    scene = cloud(count, width, height, seed=5)._replace(
        means=means,
        scales=torch.tensor([4e-4, 2e-4, 1e-4]).repeat(count, 1),
        viewmat=torch.eye(4),
        K=torch.tensor([[width, 0, 0], [0, width, 0], [0, 0, 1.0]]),
        background=torch.zeros(3),
    )
    return scene, float64_truth(scene)


@kernels
def test_sharp_splats_far_from_the_images_corner_keep_their_place(kernel, wide):
    """At 2000 pixels from the corner a float resolves an eight-thousandth of a pixel: too little for the gradients."""
    scene, truth = wide
    assert truth.rendering.alpha[:, -32:].mean() > 0.3
    accuracy = compare_with(truth, scene, kernel)
    assert accuracy.image_max < 3e-6
    assert max(accuracy.gradients.values()) < 1e-5
