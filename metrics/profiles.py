"""The metric profiles: definitions of the usual metrics in libraries and the code of papers. Light to import.

All are computed from the stored 8-bit frames. PSNR is capped at 100 dB even if the original has no cap.
"""

from __future__ import annotations

from dataclasses import replace

from ..bench.specs import MetricSpec, ProfileSpec
from .lpips import LPIPS, LPIPS_SQUEEZE, LPIPS_VGG
from .psnr import PSNR
from .ssim import SSIM

CANONICAL = ProfileSpec(
    name="canonical",
    summary="float64, valid-window Gaussian SSIM, LPIPS of inputs in [-1, 1], PSNR capped at 100 dB; the default",
    source="headbench",
    metrics=(PSNR, SSIM, LPIPS, LPIPS_VGG),
)


def _of(profile: str, metric: MetricSpec, implementation: str, summary: str) -> MetricSpec:
    """A metric of a profile; queries for the bare name do not return it."""
    return replace(
        metric,
        name=f"{metric.name}@{profile}",
        label=f"{metric.label} ({profile})",
        implementation=f"headbench.metrics.{implementation}",
        summary=summary,
        profile=profile,
        tables=(profile,),
    )


_PSNR = "psnr:psnr", "Over all pixels and channels of a frame."
_SSIM_ZERO = "ssim:ssim_zero_border", "Gaussian window 11 x 11, the image surrounded by black, every pixel."
_SSIM_VALID = "ssim:ssim", "Gaussian window 11 x 11, windows inside the image only."

GA_TRAINING = ProfileSpec(
    name="ga-training",
    summary="what GaussianAvatars' train.py prints: PSNR by channel, zero-border SSIM, LPIPS AlexNet fed [0, 1]",
    source="GaussianAvatars 30cc4bd train.py, the paper's numbers (issue 35); there from unquantised renders",
    metrics=(
        _of("ga-training", PSNR, "psnr:psnr_by_channel", "Mean of the PSNRs of red, green and blue."),
        _of("ga-training", SSIM, *_SSIM_ZERO),
        _of("ga-training", LPIPS, "lpips:lpips_unscaled", "AlexNet, inputs left in [0, 1] (issue 100)."),
    ),
)

GAUSSIAN_SPLATTING = ProfileSpec(
    name="3dgs",
    summary="what 3D Gaussian splatting's metrics.py prints: zero-border SSIM, LPIPS VGG fed [0, 1]",
    source="graphdeco-inria/gaussian-splatting metrics.py; GaussianAvatars' metrics.py is the same",
    metrics=(
        _of("3dgs", PSNR, *_PSNR),
        _of("3dgs", SSIM, *_SSIM_ZERO),
        _of("3dgs", LPIPS, "lpips:lpips_vgg_unscaled", "VGG-16, inputs left in [0, 1] (issue 1239)."),
    ),
)

NERFBASELINES = ProfileSpec(
    name="nerfbaselines",
    summary="what nerfbaselines, dm_pix, nerfstudio and torchmetrics before 1.4.2 print: valid-window SSIM",
    source="nerfbaselines cde53bd, protocols default and nerf",
    metrics=(
        _of("nerfbaselines", PSNR, *_PSNR),
        _of("nerfbaselines", SSIM, *_SSIM_VALID),
        _of("nerfbaselines", LPIPS, "lpips:lpips", "AlexNet, inputs in [-1, 1]."),
        _of("nerfbaselines", LPIPS_VGG, "lpips:lpips_vgg", "VGG-16, inputs in [-1, 1]."),
    ),
)

GSPLAT = ProfileSpec(
    name="gsplat",
    summary="what gsplat's simple_trainer prints with torchmetrics from 1.4.2: reflected-border SSIM",
    source="gsplat 90d7b4b examples/simple_trainer.py, torchmetrics 1.9.0",
    metrics=(
        _of("gsplat", PSNR, *_PSNR),
        _of("gsplat", SSIM, "ssim:ssim_reflected", "Gaussian window 11 x 11, mirrored border, every pixel."),
        _of("gsplat", LPIPS, "lpips:lpips", "AlexNet, inputs in [-1, 1] (normalize=True)."),
        _of("gsplat", LPIPS_VGG, "lpips:lpips_vgg_unscaled", "VGG-16, inputs in [0, 1] (normalize=False)."),
    ),
)

FLEXAVATAR = ProfileSpec(
    name="flexavatar",
    summary="what FlexAvatar's compute_metrics.py prints on VFHQ by torchmetrics: reflected-border SSIM, LPIPS SqueezeNet",
    source="FlexAvatar 05bb9eb scripts/compute_metrics.py and the package visage; there PSNR of 16 frames together (protocol vfhq-self)",
    metrics=(
        _of("flexavatar", PSNR, *_PSNR),
        _of(
            "flexavatar",
            SSIM,
            "ssim:ssim_reflected",
            "Gaussian window 11 x 11, mirrored border, every pixel.",
        ),
        replace(
            _of(
                "flexavatar",
                LPIPS,
                "lpips:lpips_squeeze",
                "SqueezeNet 1.1, inputs in [-1, 1] (normalize=True).",
            ),
            needs=LPIPS_SQUEEZE.needs,
        ),
    ),
)

SKIMAGE = ProfileSpec(
    name="skimage",
    summary="scikit-image's defaults, as Gaussian Head Avatar says it used: uniform 7 x 7 window, sample covariance",
    source="scikit-image 0.26 structural_similarity(channel_axis=2, data_range=255)",
    metrics=(
        _of("skimage", PSNR, *_PSNR),
        _of("skimage", SSIM, "ssim:ssim_uniform", "Uniform window 7 x 7, sample covariance, valid windows."),
    ),
)

PIQ = ProfileSpec(
    name="piq",
    summary="piq's defaults: SSIM of the image averaged down to about 256 pixels, PSNR of at most 80 dB",
    source="piq 0.8.0 psnr and ssim",
    metrics=(
        _of("piq", PSNR, "psnr:psnr_floored", "1e-8 added to the mean squared error."),
        _of("piq", SSIM, "ssim:ssim_downsampled", "Gaussian window 11 x 11 after averaging blocks, valid."),
    ),
)
