"""What there is to know of the benchmarks of this room before any of them is imported."""

from __future__ import annotations

from ..bench.specs import BenchmarkSpec

SPLATS = BenchmarkSpec(
    name="splats",
    summary="the splat renderer: time by image size, number of splats and backend; numerical extremes",
    speed="headbench.methods.splats.benchmark.speed:measure",
    tradeoffs="headbench.methods.splats.benchmark.tradeoffs:measure",
    stress="headbench.methods.splats.benchmark.stress:measure",
)

AVATAR = BenchmarkSpec(
    name="avatar",
    summary="a frame of an avatar of ours: time by step, and what each saving saves",
    speed="headbench.methods.avatar_benchmark.speed:measure",
)
