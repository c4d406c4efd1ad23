"""The metrics offered; light to import."""

from __future__ import annotations

from dataclasses import replace

from ..bench.specs import MetricSpec

PSNR = MetricSpec(
    name="psnr",
    label="PSNR",
    unit="dB",
    higher_is_better=True,
    digits=2,
    implementation="headbench.metrics.psnr:psnr",
    summary="Peak signal-to-noise ratio over the 8-bit frame, or over a region of it, capped at 100 dB.",
    regions=True,
)

SSIM = MetricSpec(
    name="ssim",
    label="SSIM",
    unit="",
    higher_is_better=True,
    digits=4,
    implementation="headbench.metrics.ssim:ssim",
    summary="Structural similarity, Gaussian window 11 x 11 of sigma 1.5, valid windows, mean over channels.",
    regions=True,
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

LPIPS_VGG = replace(
    LPIPS,
    name="lpips-vgg",
    label="LPIPS VGG",
    implementation="headbench.metrics.lpips:lpips_vgg",
    summary="Learned perceptual distance v0.1, VGG-16, inputs scaled to [-1, 1].",
)

FLIP = MetricSpec(
    name="flip",
    label="FLIP",
    unit="",
    higher_is_better=False,
    digits=4,
    implementation="headbench.metrics.flip:flip",
    summary="Difference seen when flipping between the images, LDR, 67.02 pixels per degree, mean of the map.",
    regions=True,
)

FLICKER = MetricSpec(
    name="flicker",
    label="Flicker",
    unit="levels",
    higher_is_better=False,
    digits=3,
    implementation="headbench.metrics.flicker:flicker",
    summary="Change between neighbouring frames that the truth does not have, root mean square, 8-bit levels.",
    temporal=True,
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
    tables=("comparison", "cost"),
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
    tables=("comparison", "speed"),
    machine_bound=True,
)


def _storage_detail(name: str, label: str, unit: str, digits: int, detail: str, summary: str) -> MetricSpec:
    """A further number of `STORAGE`'s measurement; less is better."""
    return replace(
        STORAGE,
        name=name,
        label=label,
        unit=unit,
        digits=digits,
        detail=detail,
        summary=summary,
        tables=("cost",),
    )


def _milliseconds(name: str, label: str, detail: str, summary: str) -> MetricSpec:
    """A time of `FPS`'s measurement."""
    return replace(
        FPS,
        name=name,
        label=label,
        unit="ms",
        higher_is_better=False,
        digits=2,
        detail=detail,
        summary=summary,
        tables=("speed",),
    )


STORAGE_PACKED = _storage_detail(
    "storage_packed", "Packed", "MB", 2, "packed_mb", "The avatar's files packed losslessly by xz."
)
STORAGE_SHARED = _storage_detail(
    "storage_shared",
    "Shared",
    "MB",
    2,
    "shared_mb",
    "Assets that all avatars of a method share, such as the head model.",
)
PRIMITIVES = _storage_detail("primitives", "Primitives", "", 0, "primitives", "Number of splats.")
PRIMITIVE_BYTES = _storage_detail(
    "primitive_bytes",
    "Per primitive",
    "B",
    1,
    "primitive_bytes",
    "Bytes of the avatar's files over its primitives.",
)
DRIVING_RATE = _storage_detail(
    "driving_rate",
    "Driving",
    "kB/s",
    2,
    "driving_kb_s",
    "Driving signal as float32, at 25 frames per second.",
)
LATENCY_P50 = _milliseconds("latency_p50", "p50", "p50_ms", "Median time of a frame, each waited for.")
LATENCY_P95 = _milliseconds("latency_p95", "p95", "p95_ms", "95 % of frames take no longer.")
LATENCY_P99 = _milliseconds("latency_p99", "p99", "p99_ms", "99 % of frames take no longer.")
LATENCY_STILL = _milliseconds(
    "latency_still", "Still", "still_ms", "Median time of a frame where neither camera nor pose changes."
)
PROCESSOR_TIME = _milliseconds(
    "processor_time", "CPU", "processor_ms", "Processor time of a frame, all threads together."
)
STAGE_DRIVE = _milliseconds(
    "stage_drive", "Drive", "drive_ms", "Median time from driving signal to mesh and features."
)
STAGE_DEFORM = _milliseconds(
    "stage_deform", "Deform", "deform_ms", "Median time from mesh to primitives as the camera sees them."
)
STAGE_RASTER = _milliseconds("stage_raster", "Raster", "raster_ms", "Median time from primitives to image.")
STAGE_POST = _milliseconds(
    "stage_post", "Post", "post_ms", "Median time of what changes the image afterwards."
)
STAGE_READ_BACK = _milliseconds(
    "stage_read_back", "Read-back", "read_back_ms", "Median time to bring the image into host memory."
)

THROUGHPUT = replace(
    FPS,
    name="throughput",
    label="Throughput",
    detail="throughput_fps",
    summary="Frames per second with up to 8 frames under way before the oldest is waited for.",
    tables=("speed",),
)

TRAINING_TIME = MetricSpec(
    name="training_time",
    label="Training",
    unit="min",
    higher_is_better=False,
    digits=2,
    implementation="headbench.metrics.training:training_time",
    summary="Wall clock of the training.",
    per_frame=False,
    training=True,
    tables=("cost",),
    machine_bound=True,
)

TRAINING_MEMORY = MetricSpec(
    name="training_memory",
    label="Peak memory",
    unit="GB",
    higher_is_better=False,
    digits=2,
    implementation="headbench.metrics.training:training_memory",
    summary="Largest resident memory of the training process.",
    per_frame=False,
    training=True,
    tables=("cost",),
    machine_bound=True,
)
