"""Benchmarks of this room. Light to import: implementations are named, not loaded."""

from ..bench.specs import BenchmarkSpec

STATISTICS = BenchmarkSpec(
    name="statistics",
    summary="Tests and intervals on simulated comparisons: do they reject and cover as often as they say?",
    stress="headbench.reports.statistics.calibration:run",
)
