"""Benchmarks of this room. Light to import: implementations are named, not loaded."""

from ..bench.contracts import BenchmarkSpec

CLUSTERS = BenchmarkSpec(
    name="clusters",
    summary="expression classes: time and memory by timesteps; landmarks against all pairs",
    speed="headbench.datasets.steps.cluster_benchmark:measure",
)
