import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from headbench.bench.errors import InputError, UnavailableError
from headbench.metrics.ssim import (
    Ssim,
    SsimForm,
    ssim,
    ssim_downsampled,
    ssim_map,
    ssim_reflected,
    ssim_uniform,
    ssim_zero_border,
)

FORMS = {
    "valid": ssim,
    "zero": ssim_zero_border,
    "reflect": ssim_reflected,
    "uniform": ssim_uniform,
    "downsampled": ssim_downsampled,
    "uniform-zero": Ssim(SsimForm("uniform", "zero")),
}
EVERY_FORM = pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
PAIRS = given(st.integers(0, 2**32 - 1), st.integers(11, 40), st.integers(11, 70), st.floats(0, 90))


def noisy_pair(seed, height=24, width=19, noise=25.0):
    """A smooth random image, and the same with noise, as 8-bit."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width][..., None]
    waves = np.sin(y * rng.uniform(0.05, 0.8, 3) + x * rng.uniform(0.05, 0.8, 3) + rng.uniform(0, 6, 3))
    truth = 127 + 120 * waves
    image = truth + rng.normal(0, noise, truth.shape)
    return tuple(np.clip(a, 0, 255).round().astype(np.uint8) for a in (image, truth))


GAUSSIAN = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}


@pytest.mark.parametrize(("form", "options"), [(ssim, GAUSSIAN), (ssim_uniform, {})])
@settings(deadline=None, max_examples=20)
@PAIRS
def test_equals_scikit_image_and_is_symmetric(form, options, seed, height, width, noise):
    image, truth = noisy_pair(seed, height, width, noise)
    expected = structural_similarity(image, truth, channel_axis=2, data_range=255, **options)
    assert form(image, truth) == pytest.approx(expected, abs=1e-10)
    assert form(image, truth) == pytest.approx(form(truth, image), abs=1e-12)


@EVERY_FORM
@settings(deadline=None, max_examples=15)
@PAIRS
def test_regions_are_means_of_the_map_and_add_up(form, seed, height, width, noise):
    image, truth = noisy_pair(seed, height, width, noise)
    inside = np.random.default_rng(seed).random((height, width)) < 0.3
    values = form.in_regions(image, truth, {"a": inside, "b": ~inside, "all": inside | True})
    inset = form.form.inset
    local = ssim_map(image, truth, form.form).mean(axis=2)
    centres = inside[inset : height - inset, inset : width - inset]
    if centres.any():
        assert values["a"] == pytest.approx(local[centres].mean(), abs=1e-12)
    assert values["all"] == pytest.approx(form(image, truth), abs=1e-12)


@EVERY_FORM
def test_constant_images_have_a_closed_form(form):
    c1 = (0.01 * 255) ** 2
    different = (
        [] if form.form.border == "zero" else [(0, 255), (100, 120)]
    )  # where black surrounds the image
    for a, b in ((255, 255), *different):
        image, truth = (np.full((30, 40, 3), level, np.uint8) for level in (a, b))
        assert form(image, truth) == pytest.approx((2 * a * b + c1) / (a * a + b * b + c1), abs=1e-9)


@EVERY_FORM
def test_an_image_below_the_smallest_has_no_value(form):
    side = form.form.smallest
    image, truth = noisy_pair(1, side, side)
    assert form(image, truth) == pytest.approx(ssim_map(image, truth, form.form).mean(), abs=1e-12)
    if side > 1:
        with pytest.raises(UnavailableError, match=f"at least {side} x {side} pixels"):
            form(image[:, 1:], truth[:, 1:])


def test_a_pixel_is_enough_where_black_surrounds_the_image():
    """Closed form: one sample under the window's centre weight, the rest 0."""
    image, truth = np.full((1, 1, 3), 200, np.uint8), np.full((1, 1, 3), 100, np.uint8)
    w = SsimForm().weights[5] ** 2
    mx, my, c1, c2 = w * 200, w * 100, (0.01 * 255) ** 2, (0.03 * 255) ** 2
    vx, vy, cov = w * 200**2 - mx**2, w * 100**2 - my**2, w * 200 * 100 - mx * my
    expected = (2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
    assert ssim_zero_border(image, truth) == pytest.approx(expected, abs=1e-12)


def test_a_one_pixel_mask_is_one_window_an_empty_one_is_left_out():
    image, truth = noisy_pair(2, 30, 30)
    one, none, edge = (np.zeros((30, 30), bool) for _ in range(3))
    one[12, 17] = edge[0, 0] = True
    values = ssim.in_regions(image, truth, {"one": one, "none": none, "edge": edge})
    assert values == {"one": pytest.approx(ssim_map(image, truth)[7, 12].mean(), abs=1e-12)}


def test_a_block_belongs_to_a_region_that_has_half_of_it():
    image, truth = noisy_pair(3, 384, 390)  # blocks of 2 pixels a side
    half, less = (np.zeros(image.shape[:2], bool) for _ in range(2))
    half[40:42, 60] = less[40, 60] = True
    values = ssim_downsampled.in_regions(image, truth, {"half": half, "less": less})
    local = ssim_map(image, truth, ssim_downsampled.form)[20 - 5, 30 - 5]
    assert values == {"half": pytest.approx(local.mean(), abs=1e-12)}


def test_a_mask_that_does_not_fit_is_refused():
    image, truth = noisy_pair(2, 30, 30)
    for mask in (np.zeros((30, 29), bool), np.zeros((30, 30), np.uint8), None):
        with pytest.raises(InputError, match="mask of face"):
            ssim.in_regions(image, truth, {"face": mask})


def test_arrays_of_any_layout_have_one_value():
    image, truth = noisy_pair(4, 33, 41)
    expected = ssim(image, truth)
    assert ssim(np.asfortranarray(image), truth) == expected
    assert ssim(image[:, ::-1], truth[:, ::-1]) == pytest.approx(expected, abs=1e-12)
    image.flags.writeable = False
    assert ssim(image, truth) == expected
