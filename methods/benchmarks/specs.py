"""The benchmarks of the renderer and of the methods. Light to import: implementations are named, not loaded."""

from ...bench.specs import BenchmarkSpec

_HERE = "headbench.methods.benchmarks"

SPLATS = BenchmarkSpec(
    name="splats",
    summary="the splat renderer: time by image size, number of splats and instruction set; numerical extremes",
    speed=f"{_HERE}.splats:speed",
    tradeoffs=f"{_HERE}.splats:tradeoffs",
    stress=f"{_HERE}.extremes:stress",
)

AVATAR = BenchmarkSpec(
    name="avatar",
    summary="a frame of an avatar of method ours compared with ga: time by size, threads and stage",
    speed=f"{_HERE}.training:avatar_speed",
)

TRAINING = BenchmarkSpec(
    name="training",
    summary="an iteration of training by operation, and its ratio to the rasteriser, for methods that train splats",
    speed=f"{_HERE}.training:training_speed",
)
