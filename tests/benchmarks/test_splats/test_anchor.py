"""The anchor draws what the renderer draws: else its time would mean nothing."""

import sys

import pytest
import torch

from headbench.bench.errors import UnavailableError
from headbench.methods.splats import rasterize
from headbench.tests.benchmarks.splats import anchor
from headbench.tests.benchmarks.splats.scenes import cloud, head_shell


def test_without_numba_it_says_what_to_install(monkeypatch):
    anchor.load.cache_clear()
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(UnavailableError, match=r"numba.*headbench\[bench\]"):
        anchor.load()


@pytest.mark.parametrize("make", [head_shell, cloud])
def test_image_and_gradients_agree_with_the_reference(make):
    pytest.importorskip("numba", reason="the anchor needs numba, of the extra `bench`")
    scene = make(150, 37, 29, seed=3)
    opacities, colors = (value.double().requires_grad_() for value in (scene.opacities, scene.colors))
    offset = torch.zeros(150, 2, dtype=torch.float64, requires_grad=True)
    geometry = [value.double() for value in scene[:3]]
    truth = rasterize(
        *geometry, opacities, colors, *scene[5:9], background=scene.background, means2d_offset=offset
    )
    upstream = torch.randn(truth.image.shape, generator=torch.Generator().manual_seed(0))
    truth.image.backward(upstream)

    passes = anchor.load()
    frame = passes.forward(scene)
    gradients = passes.backward(scene, frame, upstream.numpy())
    error = (torch.from_numpy(frame.image) - truth.image.detach()).abs()
    assert error.mean() < 1e-6
    for value, leaf in (
        (gradients.means2d, offset),
        (gradients.opacities, opacities),
        (gradients.colors, colors),
    ):
        assert leaf.grad is not None
        assert (torch.from_numpy(value) - leaf.grad).norm() < 1e-4 * leaf.grad.norm()
