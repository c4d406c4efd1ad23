"""The benchmarks that ``headbench bench`` and ``headbench stress`` run. Light to import: implementations are named, not loaded."""

from __future__ import annotations

from ...bench.specs import BenchmarkSpec

CLUSTERS = BenchmarkSpec(
    name="clusters",
    summary="expression clusters: time and memory by timesteps; landmarks against all pairs",
    speed="headbench.tests.benchmarks.clusters:measure",
)

HEAD = BenchmarkSpec(
    name="head",
    summary="the head model: time of a forward pass beside smplx; numerical extremes",
    speed="headbench.tests.benchmarks.head.speed:measure",
    stress="headbench.tests.benchmarks.head.stress:measure",
)

REFIT = BenchmarkSpec(
    name="refit",
    summary="the refit to another head model: residuals, timesteps a second beside scipy's least_squares",
    speed="headbench.tests.benchmarks.refit:measure",
)

PREPARE = BenchmarkSpec(
    name="prepare",
    summary="raw recordings to captures: images a second beside a plain OpenCV loop, peak memory by length",
    speed="headbench.tests.benchmarks.prepare:measure",
)


SPLATS = BenchmarkSpec(
    name="splats",
    summary="the splat renderer: time by image size, number of splats and backend; numerical extremes",
    speed="headbench.tests.benchmarks.splats.speed:measure",
    tradeoffs="headbench.tests.benchmarks.splats.tradeoffs:measure",
    stress="headbench.tests.benchmarks.splats.stress:measure",
)

VIEWER = BenchmarkSpec(
    name="viewer",
    summary="the viewer in a browser: updates a second while a slider moves, milliseconds by step",
    speed="headbench.tests.benchmarks.viewer:measure",
)

AVATAR = BenchmarkSpec(
    name="avatar",
    summary="a frame of an avatar of ours: time by step, and what each saving saves",
    speed="headbench.tests.benchmarks.avatar.speed:measure",
)


TRAINING = BenchmarkSpec(
    name="training",
    summary="an iteration of training by stage, and its ratio to the rasteriser, for methods that train splats",
    speed="headbench.tests.benchmarks.training:measure",
)

METRICS = BenchmarkSpec(
    name="metrics",
    summary="the image metrics: time per image next to scikit-image, torchmetrics and lpips, and equality of values",
    speed="headbench.tests.benchmarks.images:measure",
)


STATISTICS = BenchmarkSpec(
    name="statistics",
    summary="Tests and intervals on simulated comparisons: do they reject and cover as often as stated?",
    stress="headbench.tests.benchmarks.statistics:run",
)
