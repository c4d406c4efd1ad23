"""The Gaussian phase: gradients of the whole model, its images, and what it prepares of them."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from headbench.datasets.head.rotations import matrix_to_quaternion
from headbench.methods.gha.driving import HeadMotion, Signal
from headbench.methods.gha.gaussian_head import FeatureImage, GaussianHead, enlarged, near_drawn
from headbench.methods.gha.gaussian_training import Zoom, reduced, zoomed

from ..toy_clip import look_at
from .small import small_config

COUNT, CODE = 12, 4


def model(**more):
    """A tiny head in float64, with random tensors, and how it is driven."""
    config = small_config(features=3, channels=4, sr_widths=(3, 3), unit=0.05, **more)
    head = GaussianHead.of(config, CODE)
    generator = torch.Generator().manual_seed(1)

    def random(*shape, scale=1.0):
        return scale * torch.randn(*shape, generator=generator, dtype=torch.float64)

    tensors = {name: random(*shape, scale=0.5) for name, shape in head.shapes().items()}
    tensors |= {
        "points": random(COUNT, 3, scale=0.6),
        "features": random(COUNT, 3),
        "log_scales": random(COUNT, 3, scale=0.2) - 1.0,
        "quats": random(COUNT, 4),
        "opacities": random(COUNT),
        "landmarks": random(3, 3, scale=0.6),
        "code_low": torch.full((CODE,), -9.0, dtype=torch.float64),
        "code_high": torch.full((CODE,), 9.0, dtype=torch.float64),
    }
    turn = torch.tensor(Rotation.from_rotvec([0.2, -0.1, 0.3]).as_matrix())
    motion = HeadMotion(turn, random(3, scale=0.01), random(6), matrix_to_quaternion(turn))
    empty = torch.zeros(3, dtype=torch.float64)
    signal = Signal(random(CODE), empty, empty, empty, torch.zeros(2, 3, dtype=torch.float64))
    camera = look_at(np.array([0.0, 0.05, 0.4]), np.zeros(3), "c", 10, 12)
    return head, tensors, signal, motion, camera


@pytest.mark.parametrize("residual", [False, True])
def test_gradients_of_the_whole_model(residual):
    """Every tensor and the motion, through networks, splatting and super-resolution, along random directions."""
    head, tensors, signal, motion, camera = model(residual=residual)
    ground = torch.tensor([1.0, 0.5, 0.25], dtype=torch.float64)
    generator = torch.Generator().manual_seed(2)
    target = torch.rand(12, 10, 3, generator=generator, dtype=torch.float64)

    def loss(values, motion):
        drawn = head.draw(head.splats(values, signal, motion), camera, ground)
        image = head.sharpen(values, drawn, ground)
        return (image - target).square().sum() + drawn.features[..., :3].square().sum()

    variables = {
        name: value.clone().requires_grad_()
        for name, value in tensors.items()
        if name not in ("landmarks", "code_low", "code_high")
    }
    parts = [value.clone().requires_grad_() for value in motion]
    loss({**tensors, **variables}, HeadMotion(*parts)).backward()
    step = 1e-6
    for name in [*variables, *HeadMotion._fields]:
        variable = variables[name] if name in variables else parts[HeadMotion._fields.index(name)]
        direction = torch.randn(variable.shape, generator=generator, dtype=torch.float64)

        def moved(amount, name=name, direction=direction):
            if name in tensors:
                return loss({**tensors, name: tensors[name] + amount * direction}, motion).item()
            return loss(tensors, motion._replace(**{name: getattr(motion, name) + amount * direction})).item()

        numeric = (moved(step) - moved(-step)) / (2 * step)
        exact = (variable.grad * direction).sum().item()
        assert exact == pytest.approx(numeric, rel=2e-4, abs=2e-6), name


def test_a_rigid_motion_turns_splats_and_their_covariances():
    head, tensors, signal, motion, _ = model()
    identity = torch.eye(4, dtype=torch.float64)
    still = motion._replace(rotation=identity[:3, :3], translation=identity[3, :3], quaternion=identity[0])
    before, after = (head.splats(tensors, signal, m).world for m in (still, motion))
    np.testing.assert_allclose(
        after.means, before.means @ motion.rotation.t() + motion.translation, atol=1e-12
    )
    np.testing.assert_allclose(after.scales, before.scales)
    turns = [Rotation.from_quat(w.quats.numpy()[:, [1, 2, 3, 0]]).as_matrix() for w in (before, after)]
    np.testing.assert_allclose(turns[1], motion.rotation.numpy() @ turns[0], atol=1e-12)


def test_only_drawn_surroundings_are_coloured():
    alpha = torch.zeros(9, 9)
    alpha[2, 3] = 0.5
    near = near_drawn(alpha)
    expected = torch.zeros(9, 9, dtype=torch.bool)
    expected[0:5, 1:6] = True
    assert torch.equal(near, expected)
    large = enlarged(near, 2)
    assert large.shape == (18, 18)
    assert torch.equal(large[1::2, ::2], near)


@given(st.integers(1, 5), st.integers(1, 4), st.integers(1, 4))
@settings(max_examples=20, deadline=None)
def test_reduction_takes_means_or_as_published_every_nth_pixel(height, width, factor):
    image = torch.rand(height * factor, width * factor, 3, dtype=torch.float64)
    blocks = image.reshape(height, factor, width, factor, 3)
    np.testing.assert_allclose(reduced(image, factor, "paper"), blocks.mean((1, 3)))
    np.testing.assert_array_equal(reduced(image, factor, "official"), blocks[:, 0, :, 0])


def interpolated(values, factor):
    """(h, w, C) rescaled by the nearest pixel, by the function that the published code calls."""
    planes = values.permute(2, 0, 1)[None]
    return torch.nn.functional.interpolate(planes, scale_factor=factor)[0].permute(1, 2, 0)


def a_picture():
    rows, columns = np.mgrid[:12, :16]
    planes = [rows, columns, rows * 0 + 1, rows + columns]
    features = torch.tensor(np.stack(planes, -1), dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(24, 32, 3, generator=generator, dtype=torch.float64)
    return FeatureImage(features, torch.ones(12, 16)), target


@pytest.mark.parametrize("draws", [(0.0, 0.0, 0.0), (0.1, 0.7, 0.4), (0.3, 0.99, 0.99)])
def test_a_smaller_picture_is_put_somewhere_on_the_background(draws):
    drawn, target = a_picture()
    ground = torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64)
    zoom = Zoom.of((12, 16), draws)
    (height, width), (top, left) = zoom.size, (-start for start in zoom.start)
    assert height < 12
    assert 0 <= top <= 12 - height
    assert 0 <= left <= 16 - width
    smaller, small_truth = zoomed(drawn, target, zoom, ground)
    for found, whole, many, around in (
        (smaller.features, drawn.features, 1, torch.tensor([*ground, 1.0])),
        (small_truth, target, 2, ground),
    ):
        expected = around.double().expand(found.shape).clone()
        inside = interpolated(whole, zoom.factor)[: many * height, : many * width]
        expected[many * top :, many * left :][: many * height, : many * width] = inside
        assert torch.equal(found, expected)
    assert smaller.alpha.sum() == height * width  # the rest is drawn by nobody: background


@pytest.mark.parametrize("draws", [(0.99, 0.0, 0.0), (0.9, 0.3, 0.8), (0.7, 0.99, 0.99), (0.45, 0.5, 0.5)])
def test_of_a_larger_picture_some_part_is_cut_out(draws):
    drawn, target = a_picture()
    zoom = Zoom.of((12, 16), draws)
    (height, width), (top, left) = zoom.size, zoom.start
    assert 0 <= top <= height - 12
    assert 0 <= left <= width - 16
    larger, large_truth = zoomed(drawn, target, zoom, torch.zeros(3, dtype=torch.float64))
    for found, whole, many in ((larger.features, drawn.features, 1), (large_truth, target, 2)):
        cut = interpolated(whole, zoom.factor)[many * top :, many * left :]
        assert torch.equal(found, cut[: many * 12, : many * 16])
    assert larger.alpha.all()


def test_beyond_its_bounds_the_code_only_moves_points():
    head, tensors, signal, motion, _ = model()
    high = torch.full((CODE,), 0.5, dtype=torch.float64)
    tensors["code_high"] = high

    def posed(code):
        return head.splats(tensors, signal._replace(expression=code), motion)

    at, beyond, below = posed(high), posed(high + 3), posed(high - 0.5)
    torch.testing.assert_close(beyond.features, at.features)
    torch.testing.assert_close(beyond.opacities, at.opacities)
    torch.testing.assert_close(beyond.world.scales, at.world.scales)
    assert not torch.allclose(beyond.world.means, at.world.means, atol=1e-4)
    assert not torch.allclose(below.features, at.features, atol=1e-4)


def test_noise_is_for_colours_and_attributes_alone():
    head, tensors, signal, motion, _ = model()
    noise = torch.full((CODE,), 0.7, dtype=torch.float64)
    plain, noisy = head.splats(tensors, signal, motion), head.splats(tensors, signal, motion, noise)
    moved = head.splats(tensors, signal._replace(expression=signal.expression + noise), motion)
    torch.testing.assert_close(noisy.world.means, plain.world.means)
    torch.testing.assert_close(noisy.features, moved.features)
    torch.testing.assert_close(noisy.opacities, moved.opacities)
    assert not torch.allclose(noisy.features, plain.features, atol=1e-4)
