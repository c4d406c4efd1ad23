"""Each profile equals the library it is named after, by stored scores and live where the library is installed."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from headbench.bench.registry import get, resolve
from headbench.metrics.flip import flip
from headbench.metrics.lpips import lpips_squeeze
from headbench.metrics.lpips_network import Lpips
from headbench.metrics.psnr import psnr, psnr_by_channel, psnr_floored
from headbench.metrics.ssim import (
    SsimForm,
    ssim,
    ssim_downsampled,
    ssim_reflected,
    ssim_uniform,
    ssim_zero_border,
)

from .pairs import fingerprint, image_pairs

VECTORS = json.loads(Path(__file__).with_name("vectors.json").read_text())
PAIRS = image_pairs()

# What of ours equals which stored score, and to how much. Libraries take float64 here and round it in places to
# float32 (torchmetrics' PSNR, pytorch-msssim's window); flip-evaluator computes in float32.
EQUAL = [
    ("scikit-image 0.26.0", "psnr", psnr, 1e-9),
    ("scikit-image 0.26.0", "ssim_default", ssim_uniform, 1e-10),
    ("scikit-image 0.26.0", "ssim_gaussian", ssim, 1e-10),
    ("torchmetrics 1.4.1", "psnr", psnr, 1e-5),
    ("torchmetrics 1.4.1", "ssim", ssim, 1e-9),
    ("torchmetrics 1.9.0", "psnr", psnr, 1e-5),
    ("torchmetrics 1.9.0", "ssim", ssim_reflected, 1e-9),
    ("piq 0.8.0", "psnr", psnr_floored, 1e-5),
    ("piq 0.8.0", "ssim_default", ssim_downsampled, 1e-6),
    ("piq 0.8.0", "ssim_full_size", ssim, 1e-6),
    ("pytorch-msssim 1.0.0", "ssim", ssim, 1e-5),
    ("flip-evaluator 1.7", "mean", flip, 5e-5),
]


@pytest.mark.parametrize("pair", PAIRS)
@pytest.mark.parametrize(
    ("library", "score", "metric", "digits"),
    EQUAL,
    ids=[f"{library} {score}" for library, score, _, _ in EQUAL],
)
def test_stored_scores_are_reproduced(library, score, metric, digits, pair):
    assert fingerprint(PAIRS[pair]) == VECTORS["pairs"][pair], "the pair is not the one that was scored"
    assert metric(*PAIRS[pair]) == pytest.approx(VECTORS["scores"][library][pair][score], abs=digits)


@pytest.mark.parametrize("pair", ["photo", "odd", "crop"])
@pytest.mark.parametrize(("score", "scaled"), [("alex", True), ("alex_unscaled", False)])
def test_stored_lpips_are_reproduced(reference_folder, pair, score, scaled):
    expected = VECTORS["scores"]["lpips 0.1.4"][pair][score]
    assert Lpips("alex", weights=reference_folder, scaled=scaled)(*PAIRS[pair]) == pytest.approx(
        expected, abs=1e-5
    )


def test_the_stored_pairs_tell_the_forms_apart():
    """A table of conformance shows nothing where all forms agree."""
    values = [form(*PAIRS["photo"]) for form in (ssim, ssim_reflected, ssim_zero_border, ssim_uniform)]
    values.append(ssim_downsampled(*PAIRS["photo"]))
    assert np.min(np.diff(np.sort(values))) > 5e-4
    assert psnr_by_channel(*PAIRS["photo"]) > psnr(*PAIRS["photo"]) + 1e-3


def splatting_ssim(image, truth):
    """The formula of 3D Gaussian splatting's ``loss_utils``: float32, zero padding, a window of outer products."""
    x, y = (torch.tensor(a).permute(2, 0, 1)[None].float() / 255 for a in (image, truth))
    window = torch.tensor(np.outer(*[SsimForm().weights] * 2), dtype=torch.float32).expand(3, 1, 11, 11)

    def mean(values):
        return torch.nn.functional.conv2d(values, window, padding=5, groups=3)

    mx, my = mean(x), mean(y)
    vx, vy, cov = mean(x * x) - mx**2, mean(y * y) - my**2, mean(x * y) - mx * my
    top = (2 * mx * my + 0.01**2) * (2 * cov + 0.03**2)
    return float((top / ((mx**2 + my**2 + 0.01**2) * (vx + vy + 0.03**2))).mean())


@pytest.mark.parametrize("pair", PAIRS)
def test_the_training_formula_of_gaussian_splatting_agrees(pair):
    assert ssim_zero_border(*PAIRS[pair]) == pytest.approx(splatting_ssim(*PAIRS[pair]), abs=2e-5)


@pytest.mark.parametrize(
    ("profile", "metrics"),
    [
        ("canonical", {"psnr": psnr, "ssim": ssim}),
        ("ga-training", {"psnr": psnr_by_channel, "ssim": ssim_zero_border}),
        ("3dgs", {"psnr": psnr, "ssim": ssim_zero_border}),
        ("nerfbaselines", {"psnr": psnr, "ssim": ssim}),
        ("gsplat", {"psnr": psnr, "ssim": ssim_reflected}),
        ("flexavatar", {"psnr": psnr, "ssim": ssim_reflected, "lpips": lpips_squeeze}),
        ("skimage", {"psnr": psnr, "ssim": ssim_uniform}),
        ("piq", {"psnr": psnr_floored, "ssim": ssim_downsampled}),
    ],
)
def test_profiles_name_the_forms_that_were_compared(profile, metrics):
    spec = get("profiles", profile)
    found = {m.name.partition("@")[0]: resolve(m.implementation) for m in spec.metrics}
    assert {name: found[name] for name in metrics} == metrics
    scaled = {m.name: resolve(m.implementation).scaled for m in spec.metrics if "lpips" in m.name}
    unscaled = {"lpips@ga-training", "lpips@3dgs", "lpips-vgg@gsplat"}
    assert {name for name, value in scaled.items() if not value} == unscaled & set(scaled)
    assert all(m.profile == profile for m in spec.metrics)
    suffix = "" if profile == "canonical" else f"@{profile}"
    assert all(m.name.endswith(suffix) and (suffix or "@" not in m.name) for m in spec.metrics)
