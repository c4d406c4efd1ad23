"""Frames reuse memory, and never see what an earlier frame left in it."""

import gc

import psutil
import pytest
import torch

from headbench.methods.splats import available_backends
from headbench.tests.benchmarks.splats.scenes import cloud, head_shell, render_with_gradients

pytestmark = pytest.mark.skipif(
    "cpu" not in available_backends(), reason="the splat kernel is not installed: no C++ compiler was found"
)


def test_frames_of_other_scenes_in_between_change_nothing():
    scene = head_shell(1500, 70, 60)
    first = render_with_gradients(scene, torch.float32, backend="cpu")
    for seed in range(4):
        render_with_gradients(cloud(900, 90, 80, seed=seed, channels=seed + 1), torch.float32, backend="cpu")
    again = render_with_gradients(scene, torch.float32, backend="cpu")
    assert torch.equal(first.rendering.image, again.rendering.image)
    for name, gradient in first.gradients.items():
        assert torch.equal(gradient, again.gradients[name]), name


def test_memory_stays_bounded_over_frames_of_all_sizes():
    process = psutil.Process()

    def render(count: int) -> None:
        render_with_gradients(head_shell(count, 200, 180), torch.float32, backend="cpu")

    for count in range(4000, 5000, 250):
        render(count)
    gc.collect()
    before = process.memory_info().rss
    for count in range(4000, 5000, 12):
        render(count)
    gc.collect()
    # Eighty frames of some two megabytes: were they kept, it would be seen.
    assert process.memory_info().rss - before < 40 << 20
