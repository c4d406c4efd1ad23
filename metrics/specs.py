"""The metrics offered; light to import."""

from __future__ import annotations

from ..bench.specs import MetricSpec

PSNR = MetricSpec(
    name="psnr",
    label="PSNR",
    unit="dB",
    higher_is_better=True,
    digits=2,
    implementation="headbench.metrics.psnr:psnr",
    summary="Peak signal-to-noise ratio over the full 8-bit frame, capped at 100 dB.",
)

SSIM = MetricSpec(
    name="ssim",
    label="SSIM",
    unit="",
    higher_is_better=True,
    digits=4,
    implementation="headbench.metrics.ssim:ssim",
    summary="Structural similarity, Gaussian window 11 x 11 of sigma 1.5, valid windows, mean over channels.",
)

LPIPS = MetricSpec(
    name="lpips",
    label="LPIPS",
    unit="",
    higher_is_better=False,
    digits=4,
    implementation="headbench.metrics.lpips:lpips",
    summary="Learned perceptual distance v0.1, AlexNet, inputs scaled to [-1, 1].",
)

STORAGE = MetricSpec(
    name="storage",
    label="Storage",
    unit="MB",
    higher_is_better=False,
    digits=2,
    implementation="headbench.metrics.storage:storage",
    summary="Bytes of the files needed to render the avatar, SI megabytes.",
    per_frame=False,
)

FPS = MetricSpec(
    name="fps",
    label="Speed",
    unit="FPS",
    higher_is_better=True,
    digits=1,
    implementation="headbench.metrics.speed:fps",
    summary="Frames per second from driving signal to image in host memory, a new camera and pose every frame.",
    per_frame=False,
)
