"""Losses against scikit-image, a naive form, and numerical gradients."""

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from headbench.methods.shared.losses import (
    mean_over_visible,
    mean_ssim,
    photometric_loss,
    position_penalty,
    scale_penalty,
)


def images(height=30, width=26, seed=0):
    generator = torch.Generator().manual_seed(seed)
    truth = torch.rand(3, height, width, generator=generator, dtype=torch.float64)
    noise = 0.2 * torch.randn(3, height, width, generator=generator, dtype=torch.float64)
    return (truth + noise).clamp(0, 1), truth


def test_ssim_equals_scikit_images_where_the_window_stays_inside():
    # A zero border of at least the window makes zero padding the same as any other.
    image, truth = (torch.nn.functional.pad(x, (11, 11, 11, 11)) for x in images())
    expected = structural_similarity(
        image.numpy(),
        truth.numpy(),
        channel_axis=0,
        data_range=1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )[1].mean()
    assert float(mean_ssim(image, truth)) == pytest.approx(float(expected), abs=1e-7)


def test_zero_padding_counts_at_the_border():
    ones = torch.ones(3, 20, 20, dtype=torch.float64)
    assert float(mean_ssim(ones, ones)) == pytest.approx(1)
    # A constant against another constant: the window's weight inside the image decides at the border.
    border = float(mean_ssim(ones, 0.5 * ones))
    inner = (2 * 0.5 + 1e-4) / (1 + 0.25 + 1e-4)
    assert border < inner


def test_gradient_of_ssim():
    image, truth = images(13, 12)
    image.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: mean_ssim(x, truth), image)


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_photometric_loss_mixes_l1_and_ssim(weight):
    image, truth = (x.permute(1, 2, 0) for x in images(seed=1))
    l1 = np.abs(image.numpy() - truth.numpy()).mean()
    ssim = float(mean_ssim(image.permute(2, 0, 1).contiguous(), truth.permute(2, 0, 1).contiguous()))
    expected = (1 - weight) * l1 + weight * (1 - ssim)
    assert float(photometric_loss(image, truth, weight)) == pytest.approx(expected)


def test_penalties_are_means_over_visible_splats_beyond_the_threshold():
    rng = np.random.default_rng(2)
    means, log_scales = rng.normal(size=(9, 3)), rng.normal(size=(9, 3))
    visible = rng.random(9) < 0.6
    far = [max(np.linalg.norm(m) - 1, 0) for m in means[visible]]
    large = [np.linalg.norm(np.maximum(np.exp(s) - 0.6, 0)) for s in log_scales[visible]]
    mask = torch.from_numpy(visible)
    assert float(position_penalty(torch.from_numpy(means), mask, 1.0)) == pytest.approx(np.mean(far))
    assert float(scale_penalty(torch.from_numpy(log_scales), mask, 0.6)) == pytest.approx(np.mean(large))


def test_penalties_have_zero_gradient_where_nothing_exceeds():
    means = torch.zeros(4, 3, requires_grad=True)
    log_scales = torch.full((4, 3), -5.0, requires_grad=True)
    visible = torch.ones(4, dtype=torch.bool)
    (position_penalty(means, visible, 1.0) + scale_penalty(log_scales, visible, 0.6)).backward()
    assert (means.grad == 0).all()
    assert (log_scales.grad == 0).all()


def test_nothing_visible_costs_nothing():
    assert float(mean_over_visible(torch.ones(3), torch.zeros(3, dtype=torch.bool))) == 0
