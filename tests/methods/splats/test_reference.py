"""The reference renderer against closed forms, finite differences and a brute-force renderer."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from headbench.methods.benchmarks.splats import (
    DIFFERENTIABLE,
    SplatScene,
    cloud,
    relative_error,
    render_with_gradients,
)
from headbench.methods.splats import pixel_weights, rasterize
from headbench.methods.splats.reference import rotation_matrices

from .dense import render_dense

F64 = torch.float64
FOCAL, DEPTH, SIZE = 40.0, 2.0, 21
K = torch.tensor([[FOCAL, 0, 10.5], [0, FOCAL, 10.5], [0, 0, 1]], dtype=F64)


def on_axis(depths, scales, opacities, colors):
    """Isotropic splats on the optical axis, one per entry."""
    count = len(depths)
    means = torch.zeros(count, 3, dtype=F64)
    means[:, 2] = torch.tensor(depths, dtype=F64)
    quats = torch.tensor([[1.0, 0, 0, 0]], dtype=F64).repeat(count, 1)
    scales, opacities, colors = (torch.tensor(values, dtype=F64) for values in (scales, opacities, colors))
    return (
        means,
        quats,
        scales[:, None].repeat(1, 3),
        opacities,
        colors,
        torch.eye(4, dtype=F64),
        K,
        SIZE,
        SIZE,
    )


def test_one_isotropic_splat_has_the_closed_form():
    scale, opacity = 0.1, 0.7
    result = rasterize(*on_axis([DEPTH], [scale], [opacity], [[2.0]]), background=[0.5], backend="reference")
    # On the axis the projection of an isotropic Gaussian is isotropic, of variance (f s / z)² + 0.3.
    variance = (FOCAL * scale / DEPTH) ** 2 + 0.3
    offset = torch.arange(SIZE, dtype=F64) - 10
    alpha = opacity * torch.exp(-(offset[:, None] ** 2 + offset**2) / (2 * variance))
    alpha[alpha < 1 / 255] = 0
    torch.testing.assert_close(result.alpha, alpha, atol=1e-14, rtol=0)
    torch.testing.assert_close(result.image[..., 0], 2 * alpha + 0.5 * (1 - alpha), atol=1e-14, rtol=0)
    # Where the published square root of a difference would be of 0, it takes 0.1.
    assert result.radii.tolist() == [math.ceil(3 * math.sqrt(variance + math.sqrt(0.1)))]


def test_antialiasing_fades_a_splat_by_the_area_the_filter_adds():
    scale, opacity = 0.02, 0.7
    result = rasterize(*on_axis([DEPTH], [scale], [opacity], [[2.0]]), antialiased=True, backend="reference")
    sharp = (FOCAL * scale / DEPTH) ** 2
    assert result.alpha[10, 10].item() == pytest.approx(opacity * sharp / (sharp + 0.3), abs=1e-14)


def test_nearer_splat_covers_the_farther_whatever_their_order():
    near_first = on_axis([2.0, 3.0], [0.1, 0.1], [0.6, 0.5], [[1.0, 0.0], [0.0, 1.0]])
    far_first = on_axis([3.0, 2.0], [0.1, 0.1], [0.5, 0.6], [[0.0, 1.0], [1.0, 0.0]])
    one, two = (rasterize(*s, backend="reference") for s in (near_first, far_first))
    torch.testing.assert_close(one.image[10, 10], torch.tensor([0.6, 0.4 * 0.5], dtype=F64))
    assert torch.equal(one.image, two.image)
    # Equal depths keep the order of indices.
    equal = on_axis([2.0, 2.0], [0.1, 0.1], [0.5, 0.5], [[1.0, 0.0], [0.0, 1.0]])
    image = rasterize(*equal, backend="reference").image
    torch.testing.assert_close(image[10, 10], torch.tensor([0.5, 0.25], dtype=F64))


def test_alpha_is_clamped_and_the_clamp_stops_the_gradient():
    inputs = list(on_axis([DEPTH], [0.1], [1.0], [[1.0]]))
    inputs[3].requires_grad_()
    result = rasterize(*inputs, backend="reference")
    assert result.alpha[10, 10].item() == pytest.approx(0.99)
    (gradient,) = torch.autograd.grad(result.image[10, 10, 0], inputs[3], retain_graph=True)
    assert gradient.item() == 0
    (gradient,) = torch.autograd.grad(result.image[10, 12, 0], inputs[3])
    assert gradient.item() > 0


def test_pixel_stops_before_the_splat_that_would_make_it_opaque():
    # Transmittance 1, 0.01, 2e-4, and then 2e-5 would pass the limit of 1e-4: that splat is left out with all behind
    # it, even the last, which by itself would not pass it.
    inputs = on_axis([1.0, 2.0, 3.0, 4.0], [0.2] * 4, [0.99, 0.98, 0.9, 0.3], [[1.0], [10.0], [1e3], [1e4]])
    result = rasterize(*inputs, backend="reference")
    assert float(result.alpha[10, 10]) == pytest.approx(1 - 0.01 * 0.02)
    assert float(result.image[10, 10, 0]) == pytest.approx(0.99 + 10 * 0.01 * 0.98)


@pytest.mark.parametrize("seed", range(3))
def test_agrees_with_brute_force(seed):
    scene = cloud(80, 37, 26, seed=seed)
    truth = render_dense(scene)
    result = rasterize(
        *(v.double() if torch.is_tensor(v) else v for v in scene[:9]), background=scene.background
    )
    assert truth.safe.float().mean() > 0.8
    torch.testing.assert_close(result.image[truth.safe], truth.image[truth.safe], rtol=0, atol=1e-9)
    torch.testing.assert_close(result.alpha[truth.safe], truth.alpha[truth.safe], rtol=0, atol=1e-9)


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_agree_with_finite_differences(antialiased):
    # Faint wide splats: every one reaches every pixel, so no threshold makes the image jump.
    scene = cloud(4, 4, 3, seed=3, size=0.4, opacity=-1.0)
    scene = scene._replace(
        means=scene.means * torch.tensor([0.2, 0.2, 0.1]) + torch.tensor([0.0, 0.0, 1.5]),
        opacities=scene.opacities.clamp(0.2, 0.5),
    )
    inputs = *scene[:7], scene.background, torch.zeros(len(scene.means), 2)
    leaves = [value.double().requires_grad_() for value in inputs]

    def render(*tensors):
        *geometry, background, offset = tensors
        options = {"background": background, "means2d_offset": offset, "antialiased": antialiased}
        result = rasterize(*geometry, scene.width, scene.height, **options)
        return result.image, result.alpha

    assert len(leaves) == len(DIFFERENTIABLE)
    assert torch.autograd.gradcheck(render, leaves, eps=1e-6, atol=1e-6, check_undefined_grad=False)


def test_gradients_where_slopes_are_clamped():
    # A wide splat beyond the widened frustum that still reaches into the image.
    scene = cloud(1, 6, 5, seed=1)._replace(
        means=torch.tensor([[2.2, 0.1, 1.0]]),
        scales=torch.tensor([[0.9, 0.8, 0.7]]),
        opacities=torch.tensor([0.8]),
        viewmat=torch.eye(4),
    )
    leaves = [value.double().requires_grad_() for value in (scene.means, scene.viewmat, scene.K)]

    def render(means, viewmat, K):
        rest = (v.double() for v in scene[1:5])
        return rasterize(means, *rest, viewmat, K, scene.width, scene.height).image

    assert render(*leaves).abs().max() > 0.01
    assert torch.autograd.gradcheck(render, leaves, eps=1e-6, atol=1e-6)


def test_tiles_and_chunks_do_not_show(monkeypatch):
    from headbench.methods.splats import reference

    scene = cloud(60, 40, 35, seed=5)
    whole = render_with_gradients(scene, F64, backend="reference")
    monkeypatch.setattr(reference, "TILE", 7)
    monkeypatch.setattr(reference, "CHUNK", 5)
    cut = render_with_gradients(scene, F64, backend="reference")
    torch.testing.assert_close(cut.rendering.image, whole.rendering.image, rtol=0, atol=1e-12)
    for name, gradient in whole.gradients.items():
        assert relative_error(cut.gradients[name], gradient) < 1e-10, name


def test_rotation_matrices_agree_with_scipy_at_any_length():
    quats = torch.randn(50, 4, dtype=F64, generator=torch.Generator().manual_seed(0))
    truth = torch.from_numpy(Rotation.from_quat(quats[:, [1, 2, 3, 0]].numpy()).as_matrix())
    for length in (1.0, 1e-9, 1e150):
        torch.testing.assert_close(rotation_matrices(length * quats), truth, rtol=0, atol=1e-12)
    assert torch.equal(rotation_matrices(torch.zeros(1, 4))[0], torch.eye(3))


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), angle=st.floats(-3, 3), shift=st.floats(-5, 5))
def test_moving_splats_and_camera_together_changes_nothing(seed, angle, shift):
    scene = SplatScene(*(v.double() if torch.is_tensor(v) else v for v in cloud(12, 18, 17, seed=seed)))
    turn = Rotation.from_rotvec([0.3 * angle, angle, -0.7 * angle])
    motion = torch.eye(4, dtype=F64)
    motion[:3, :3] = torch.from_numpy(turn.as_matrix())
    motion[:3, 3] = torch.tensor([shift, -2 * shift, 0.5])
    turned = (turn * Rotation.from_quat(scene.quats[:, [1, 2, 3, 0]].numpy())).as_quat()
    moved = scene._replace(
        means=scene.means @ motion[:3, :3].T + motion[:3, 3],
        quats=torch.from_numpy(turned[:, [3, 0, 1, 2]]),
        viewmat=scene.viewmat @ torch.linalg.inv(motion),
    )
    # Pixels at a threshold may jump with the last bit of the motion.
    safe = render_dense(scene).safe
    one, two = (rasterize(*s[:9], background=s.background) for s in (scene, moved))
    torch.testing.assert_close(one.image[safe], two.image[safe], rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_weights_times_colours_are_the_image(seed):
    """Against a brute-force renderer, with splats behind each other, opaque ones, and ones beyond the border."""
    scene = cloud(300, 40, 30, seed=seed)
    values = (part.double() if isinstance(part, torch.Tensor) else part for part in scene)
    scene = SplatScene(*values)._replace(background=torch.zeros(3, dtype=F64))
    drawn = render_dense(scene)
    splats, pixels, weights = pixel_weights(*scene[:4], *scene[5:9])
    image = torch.zeros(30 * 40, 3, dtype=F64).index_add_(0, pixels, weights[:, None] * scene.colors[splats])
    torch.testing.assert_close(image.view(30, 40, 3), drawn.image, atol=1e-9, rtol=0)
    alpha = torch.zeros(30 * 40, dtype=F64).index_add_(0, pixels, weights)
    torch.testing.assert_close(alpha.view(30, 40), drawn.alpha, atol=1e-9, rtol=0)
