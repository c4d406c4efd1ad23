"""The kernel, in every instruction set this machine runs, against the float64 reference.

Numerical extremes and numbers of threads are in tests/methods/benchmarks/test_extremes.py.
"""

from __future__ import annotations

import os
import signal
import threading
import time

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from headbench.methods.benchmarks.splats import (
    DrawnScene,
    SplatScene,
    cloud,
    head_shell,
    relative_error,
    render_with_gradients,
)
from headbench.methods.splats import cuda, rasterize

from .cases import backends, check_kernels, compare_with, float64_truth, kernels, needs_kernel, request_of
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


pytestmark = [needs_kernel, pytest.mark.usefixtures("one_torch_thread")]


def replaced(scene: SplatScene, **parts) -> SplatScene:
    """A scene whose first splats take other values: ``parts`` are rows by field name."""
    fields = {}
    for name, rows in parts.items():
        value = getattr(scene, name).clone()
        value[: len(rows)] = torch.tensor(rows)
        fields[name] = value
    return scene._replace(**fields)


QUATERNIONS = [
    [0.0, 0, 0, 0],
    [1e-25, 0, 0, 0],
    [1e20, 2e20, -1e20, 0],
    [0, 3, 0, 0],
    [1e-11, 2e-11, 0, 1e-11],
]
SCENES = {
    "odd size": lambda: cloud(150, 61, 45, seed=1),
    "one channel": lambda: cloud(120, 33, 17, seed=2, channels=1),
    "four channels": lambda: cloud(120, 20, 31, seed=3, channels=4),
    "five channels": lambda: cloud(100, 16, 16, seed=4, channels=5),
    "32 channels": lambda: cloud(100, 40, 24, seed=5, channels=32),
    "one pixel": lambda: cloud(200, 1, 1, seed=6, size=0.2),
    "one row": lambda: cloud(150, 50, 1, seed=7, size=0.1),
    "many faint in a tile": lambda: cloud(1500, 18, 19, seed=8, size=0.2, opacity=-4.5),
    "many opaque in a tile": lambda: cloud(1500, 18, 19, seed=9, size=0.1, opacity=4.0),
    "smaller than pixels": lambda: cloud(400, 48, 40, seed=10, size=1e-4, opacity=2.0),
    "larger than the image": lambda: cloud(60, 30, 30, seed=11, size=1.5, opacity=-2.0),
    "quaternions of any length": lambda: replaced(cloud(80, 32, 32, seed=12), quats=QUATERNIONS),
    "opacities at their ends": lambda: replaced(
        cloud(80, 32, 32, seed=13, size=0.1), opacities=[0.0, 1.0, 1.0, 1 / 256, 1 / 250, 0.99, 1.0, 0.0]
    ),
    "zero scales": lambda: replaced(
        cloud(80, 32, 32, seed=14), scales=[[0.0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0]]
    ),
}


@pytest.mark.parametrize("antialiased", [False, True], ids=["plain", "antialiased"])
@pytest.mark.parametrize("name", SCENES)
def test_image_and_gradients_agree_with_the_reference(name, antialiased):
    scene = SCENES[name]()
    if antialiased and name == "smaller than pixels":
        scene = scene._replace(scales=30 * scene.scales)  # else nothing would be left to see
    check_kernels(scene, antialiased=antialiased)


@kernels
def test_empty_scenes_show_the_background(kernel):
    nothing = cloud(0, 21, 18)
    behind = cloud(30, 21, 18)
    behind = behind._replace(means=behind.means - torch.tensor([0.0, 0.0, 20.0]))
    for scene in (nothing, behind):
        result = render_with_gradients(scene, torch.float32, backend=kernel)
        assert torch.equal(result.rendering.image, scene.background.expand(18, 21, 3))
        assert not result.rendering.alpha.any()
        assert not result.rendering.radii.any()
        for name, gradient in result.gradients.items():
            assert bool(gradient.any()) == (name == "background"), name
        truth = render_with_gradients(scene, torch.float64, backend="reference")
        assert relative_error(result.gradients["background"], truth.gradients["background"]) < 1e-6


def test_arrays_need_not_be_contiguous():
    scene = cloud(90, 30, 26, seed=30)
    plain = render_with_gradients(scene, torch.float32, backend="cpu")
    strided = [
        value.t().contiguous().t() if value.ndim == 2 else value.repeat_interleave(2)[::2]
        for value in scene[:5]
    ]
    assert not any(value.is_contiguous() for value in strided)
    leaves = [value.requires_grad_() for value in strided]
    view = scene.viewmat.t().contiguous().t()
    result = rasterize(
        *leaves, view, scene.K.t().contiguous().t(), 30, 26, background=scene.background, backend="cpu"
    )
    assert torch.equal(result.image, plain.rendering.image)
    upstream = torch.randn(26, 30, 3)
    transposed = upstream.permute(1, 0, 2).contiguous().permute(1, 0, 2)
    wanted = torch.autograd.grad(result.image, leaves, upstream, retain_graph=True)
    for a, b in zip(wanted, torch.autograd.grad(result.image, leaves, transposed), strict=True):
        assert torch.equal(a, b)


def test_renders_in_a_forked_child():
    scene = head_shell(2000, 64, 64)
    before = rasterize(*scene[:9], backend="cpu", threads=3).image
    child = os.fork()
    if child == 0:  # only the outcome may leave the child: no exception, no pytest
        same = False
        try:
            same = torch.equal(rasterize(*scene[:9], backend="cpu", threads=3).image, before)
        finally:
            os._exit(0 if same else 1)
    deadline = time.monotonic() + 20
    while (status := os.waitpid(child, os.WNOHANG)) == (0, 0):
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            pytest.fail("the forked child hangs: its thread pool is the parent's")
        time.sleep(0.01)
    assert os.waitstatus_to_exitcode(status[1]) == 0
    assert torch.equal(rasterize(*scene[:9], backend="cpu", threads=3).image, before)


def test_threads_of_one_process_may_render_at_once():
    scenes = [head_shell(1500, 60, 50, seed=seed) for seed in range(4)]
    alone = [rasterize(*scene[:9], backend="cpu", threads=2).image for scene in scenes]
    together: dict[int, list[torch.Tensor]] = {}

    def render(index: int) -> None:
        together[index] = [rasterize(*scenes[index][:9], backend="cpu", threads=2).image for _ in range(10)]

    workers = [threading.Thread(target=render, args=(index,)) for index in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    for index, image in enumerate(alone):
        assert len(together[index]) == 10
        assert all(torch.equal(other, image) for other in together[index])


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    width=st.integers(1, 40),
    height=st.integers(1, 40),
    channels=st.integers(1, 6),
)
def test_order_of_splats_never_matters(seed, width, height, channels):
    scene = cloud(60, width, height, seed=seed, channels=channels)
    order = torch.randperm(60, generator=torch.Generator().manual_seed(seed))
    shuffled = [value[order] for value in scene[:5]]
    one = rasterize(*scene[:9], backend="cpu")
    two = rasterize(*shuffled, *scene[5:9], backend="cpu")
    assert torch.equal(one.image, two.image)
    assert torch.equal(one.radii[order], two.radii)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), size=st.floats(1e-3, 1.0), opacity=st.floats(-4, 4))
def test_image_is_affine_in_colours_and_background(seed, size, opacity):
    scene = cloud(40, 25, 22, seed=seed, size=size, opacity=opacity)
    result = rasterize(*scene[:9], background=scene.background, backend="cpu")
    assert result.alpha.min() >= 0
    assert result.alpha.max() <= 1
    doubled = scene._replace(colors=2 * scene.colors)
    twice = rasterize(*doubled[:9], background=2 * scene.background, backend="cpu")
    assert torch.equal(twice.image, 2 * result.image)
    white = rasterize(*scene._replace(colors=torch.ones_like(scene.colors))[:9], backend="cpu")
    torch.testing.assert_close(white.image[..., 0], result.alpha, rtol=0, atol=2e-6)


@pytest.fixture(
    scope="module", params=[(8_000, 160, 234), pytest.param((60_000, 550, 802), marks=pytest.mark.slow)]
)
def frame(request) -> tuple[SplatScene, DrawnScene]:
    scene = head_shell(*request.param)
    return scene, float64_truth(scene)


@kernels
def test_whole_frames_are_exact(kernel, frame):
    """Floors for any scene. Where an alpha lies on a threshold a pixel may fall on the other side: few may."""
    scene, truth = frame
    accuracy = compare_with(truth, scene, kernel)
    assert accuracy.image_mean <= 1e-6
    assert accuracy.pixels_equal >= 0.9999
    for name, error in accuracy.gradients.items():
        assert error <= (2e-4 if name == "quats" else 1e-4), name


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
def wide() -> tuple[SplatScene, DrawnScene]:
    """Splats a pixel wide at the right end of a wide image."""
    width, height, count = 2048, 16, 300
    rng = torch.Generator().manual_seed(6)
    means = torch.rand(count, 3, generator=rng) * torch.tensor([0.006, 0.008, 0.5])
    means += torch.tensor([0.99, 0, 1])
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
def test_sharp_splats_far_from_the_corner_keep_their_place(kernel, wide):
    """At 2000 pixels from the corner a float resolves an eight-thousandth of a pixel: too little for the gradients."""
    scene, truth = wide
    assert truth.rendering.alpha[:, -32:].mean() > 0.3
    accuracy = compare_with(truth, scene, kernel)
    assert accuracy.image_max < 3e-6
    assert max(accuracy.gradients.values()) < 1e-5
