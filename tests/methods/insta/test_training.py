"""Losses against their formulas, colours against the other decoder of sRGB in the house."""

import numpy as np
import pytest
import torch

from headbench.datasets.images import srgb_to_linear
from headbench.methods.insta.config import InstaConfig
from headbench.methods.insta.training import color_loss, depth_loss, target_colors, to_linear, to_srgb


def test_the_color_loss_is_hubers():
    color = torch.tensor([[0.5, 0.5, 0.5], [0.2, 0.0, 0.0]], requires_grad=True)
    target = torch.tensor([[0.45, 0.5, 0.5], [0.9, 0.0, 0.0]])
    weights = torch.tensor([1.0, 40.0])
    # Square below 0.1: d^2 / (2 delta). Linear above: |d| - delta / 2. Sum of three channels, mean of two rays; a fifth.
    expected = 0.2 * 0.5 * (0.05**2 / 0.2 + 40 * (0.7 - 0.05))
    loss = color_loss(color, target, weights, 0.1)
    assert loss.item() == pytest.approx(expected, rel=1e-5)
    loss.backward()
    assert color.grad[1, 0].item() == pytest.approx(-0.2 * 0.5 * 40)


def test_rays_without_depth_count_for_nothing():
    distance = torch.tensor([1.0, 2.0, 3.0], requires_grad=True)
    loss = depth_loss(distance, torch.tensor([1.5, torch.inf, 2.0]))
    assert loss.item() == pytest.approx(1.5 / 3)
    loss.backward()
    assert distance.grad.tolist() == pytest.approx([-1 / 3, 0, 1 / 3])


def test_linear_light_agrees_and_comes_back():
    values = torch.linspace(0, 1, 257, dtype=torch.float64)
    np.testing.assert_allclose(to_linear(values), srgb_to_linear(values.numpy()), atol=1e-12)
    torch.testing.assert_close(to_srgb(to_linear(values)), values, atol=1e-6, rtol=0)


@pytest.mark.parametrize("variant", ["paper", "official"])
def test_backgrounds_are_exchanged(variant):
    config = InstaConfig(target_variant=variant)
    own = torch.tensor([[0.8, 0.3, 0.1]])
    was, new = torch.tensor([1.0, 1.0, 1.0]), torch.tensor([[0.1, 0.9, 0.4]])
    for coverage, expected in ((1.0, own), (0.0, new)):
        alpha = torch.tensor([[coverage]])
        image = alpha * own + (1 - alpha) * was
        torch.testing.assert_close(target_colors(image, alpha, was, new, config), expected, atol=1e-6, rtol=0)
    alpha = torch.tensor([[0.25]])
    mixed = target_colors(alpha * own + (1 - alpha) * was, alpha, was, new, config)
    straight = alpha * own + (1 - alpha) * new
    if variant == "official":
        straight = to_srgb(alpha * to_linear(own) + (1 - alpha) * to_linear(new))
    torch.testing.assert_close(mixed, straight, atol=1e-5, rtol=0)
