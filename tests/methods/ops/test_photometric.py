"""SSIM as training has it, against scikit-image and numerical gradients."""

import pytest
import torch
from skimage.metrics import structural_similarity

from headbench.methods.ops.photometric import mean_ssim


def images(height=30, width=26, seed=0):
    generator = torch.Generator().manual_seed(seed)
    truth = torch.rand(3, height, width, generator=generator, dtype=torch.float64)
    noise = 0.2 * torch.randn(3, height, width, generator=generator, dtype=torch.float64)
    return (truth + noise).clamp(0, 1), truth


def test_ssim_equals_scikit_images_where_the_window_stays_inside():
    # A zero border of at least the window makes zero padding the same as any other.
    image, truth = (torch.nn.functional.pad(x, (11, 11, 11, 11)) for x in images())
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    expected = structural_similarity(image.numpy(), truth.numpy(), channel_axis=0, full=True, **options)[1]
    assert float(mean_ssim(image, truth)) == pytest.approx(float(expected.mean()), abs=1e-7)


def test_gradient_of_ssim():
    image, truth = images(13, 12)
    image.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: mean_ssim(x, truth), image)
