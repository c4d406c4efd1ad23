"""Benchmarks of this room. Light to import: implementations are named, not loaded."""

from ..bench.specs import BenchmarkSpec

CLUSTERS = BenchmarkSpec(
    name="clusters",
    summary="expression classes: time and memory by timesteps; landmarks against all pairs",
    speed="headbench.datasets.steps.cluster_benchmark:measure",
)

HEAD = BenchmarkSpec(
    name="head",
    summary="the head model: time of a forward pass beside smplx; numerical extremes",
    speed="headbench.datasets.head.benchmark.speed:measure",
    stress="headbench.datasets.head.benchmark.stress:measure",
)

REFIT = BenchmarkSpec(
    name="refit",
    summary="the refit to another head model: residuals, timesteps a second beside scipy's least_squares",
    speed="headbench.datasets.refit.benchmark:measure",
)

PREPARE = BenchmarkSpec(
    name="prepare",
    summary="raw recordings to captures: images a second beside a plain OpenCV loop, peak memory by length",
    speed="headbench.datasets.nersemble.benchmark:measure",
)
