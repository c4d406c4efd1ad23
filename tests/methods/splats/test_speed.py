"""How fast the kernel is. Shows a table with ``pytest -m slow -s``; asserts only what any machine must reach."""

from __future__ import annotations

import time

import pytest
import torch

from headbench.methods.splats import available_backends, rasterize
from headbench.tests.benchmarks.splats.scenes import Scene, head_shell

pytestmark = pytest.mark.skipif(
    "cpu" not in available_backends(), reason="the splat kernel is not installed: no C++ compiler was found"
)


def seconds(scene: Scene, backend: str, repeats: int) -> tuple[float, float]:
    """Least processor time of one frame on one thread: forward alone, and with the backward pass."""
    leaves = [value.clone().requires_grad_() for value in scene[:5]]
    upstream = torch.randn(scene.height, scene.width, scene.colors.shape[1])
    forward, both = [], []
    for _ in range(repeats):
        start = time.process_time()
        image = rasterize(*leaves, *scene[5:9], background=scene.background, backend=backend, threads=1).image
        forward.append(time.process_time() - start)
        image.backward(upstream)
        both.append(time.process_time() - start)
    return min(forward), min(both)


@pytest.fixture
def one_thread():
    """Torch on one thread, so that processor time is comparable."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_kernel_is_far_faster_than_the_reference():
    for count, width, height in ((5_000, 128, 184), (20_000, 275, 401), (60_000, 550, 802)):
        for backend in available_backends()[1:-1]:
            forward, both = seconds(head_shell(count, width, height), backend, 10)
            frame = f"{width}x{height}, {count} splats"
            print(
                f"\n{backend:13} {frame:24} forward {1e3 * forward:6.1f} ms, with backward {1e3 * both:6.1f} ms",
                end="",
            )
    scene = head_shell(5_000, 128, 184)
    _, reference = seconds(scene, "reference", 1)
    _, kernel = seconds(scene, "cpu", 10)
    print(f"\nreference over kernel at 128x184: {reference / kernel:.0f}")
    assert reference > 20 * kernel
