"""What there is to know of the benchmarks of this room before any of them is imported."""

from __future__ import annotations

from ..bench.specs import BenchmarkSpec

METRICS = BenchmarkSpec(
    name="metrics",
    summary="the image metrics: time per image next to scikit-image, torchmetrics and lpips, and equality of values",
    speed="headbench.metrics.image_benchmark.speed:measure",
)
