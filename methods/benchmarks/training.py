"""``headbench doctor bench training``: an iteration of each method that trains splats, against the rasteriser's two passes.

Splats lie at random on the procedural head, as training leaves them, and the images are rendered from an untrained avatar,
since the cost of an iteration does not depend on the content.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

from ...bench.configuration import build
from ...bench.contracts import Progress
from ...bench.doctor import Row, findings, take_turns
from ...bench.specs import CommandResult, MethodSpec
from ...datasets.head.procedural.model import procedural_head
from ..ga.config import GAConfig
from ..ga.method import GAAppearance
from ..ga.spec import GA
from ..gbs.config import GBSConfig
from ..gbs.spec import GBS
from ..gbs.training import GBSTraining
from ..ours.appearance import OursAppearance
from ..ours.config import OursConfig
from ..ours.spec import OURS
from ..shared import rendering
from ..shared.avatar_files import Subject
from ..shared.schedule import ShuffledEpochs, Timeline
from ..shared.splat_training import BoundTraining, SplatTrainer, Start
from ..shared.subject_mesh import SubjectMesh
from ..shared.threads import torch_threads
from .untrained import MemoryClip, untrained, with_images

SIZE = (144, 208)  # of the demo's images
SPLATS = 20_000  # the most that the demo's preset allows
QUICK_SPLATS = 13_000  # above one a triangle
ROUNDS, QUICK_ROUNDS = 30, 5
ITERATION, LENGTH = 1_200, 2_000  # lines and harmonics of every degree are on
SHOWN = 12
"""Operations shown for each method; the others are added up."""


def speed(quick: bool, progress: Progress) -> CommandResult:
    """Time an iteration of each method at the demo's size and preset, by operation."""
    count, rounds = (QUICK_SPLATS, QUICK_ROUNDS) if quick else (SPLATS, ROUNDS)
    clip = with_images(*untrained(count, *SIZE))
    iterations: list[Row] = []
    operations: list[Row] = []
    with torch_threads(1):
        for number, (name, make) in enumerate(METHODS.items()):
            progress(number, len(METHODS), name)
            training = make(clip, count)
            try:
                training.begin(Timeline(LENGTH, 600_000))
                least = measure(training, rounds)
                iterations.append({"method": name, "splats": len(training.binding), **least})
                operations += [{"method": name, **row} for row in profiled(training, rounds)]
            finally:
                training.close()
    note = (
        f"{SIZE[0]}x{SIZE[1]}, one thread. Processor ms, the least of runs that take turns: an iteration without a round of "
        "densification,\nand the rasteriser's two passes. Operations: torch's profiler, ms by the clock and % of an iteration, "
        "without what an\noperation calls."
    )
    return findings({"Iterations": iterations, "Operations": operations}, note)


def measure(training: SplatTrainer, rounds: int) -> Row:
    """Minimum processor time, ms, of an iteration and of its rasteriser alone, measured alternately, and their ratio."""
    seconds = take_turns(
        {"iteration": lambda: iterate(training), "rasteriser": _rasteriser(training)},
        rounds,
        time.thread_time,
    )
    iteration, rasteriser = (1e3 * min(seconds[name]) for name in ("iteration", "rasteriser"))
    return {"iteration": iteration, "rasteriser": rasteriser, "ratio": iteration / rasteriser}


def iterate(training: SplatTrainer) -> None:
    """An iteration without a round of densification, which would change the number of splats."""
    training.loss(ITERATION, 0).backward()
    offset, visible, camera, _ = training._seen
    assert offset.grad is not None
    training._densifier.observe(offset.grad, visible, camera.width, camera.height)
    training.optimiser.step()
    training.optimiser.zero_grad()


def _rasteriser(training: SplatTrainer) -> Callable[[], None]:
    """A function that runs the rasteriser's two passes as an iteration calls them."""
    rasterize, calls = rendering.rasterize, []

    def noting(*arguments: Any, **options: Any) -> Any:
        calls.append((arguments, options))
        return rasterize(*arguments, **options)

    rendering.rasterize = noting
    try:
        training.loss(ITERATION, 0)
    finally:
        rendering.rasterize = rasterize
    ((arguments, options),) = calls

    def leaf(value: Any) -> Any:
        if not isinstance(value, torch.Tensor):
            return value
        return value.detach().clone().requires_grad_(value.requires_grad)

    inputs = [leaf(value) for value in arguments]
    options = {name: leaf(value) for name, value in options.items()}

    def run() -> None:
        drawn = rasterize(*inputs, **options)
        (drawn.image.sum() + drawn.alpha.sum()).backward()

    return run


def profiled(training: SplatTrainer, rounds: int) -> list[Row]:
    """Time of an iteration by operation; operations of compiled passes have the names of their classes."""
    with profile(activities=[ProfilerActivity.CPU]) as found:
        for _ in range(rounds):
            iterate(training)
    own = {event.key: 1e-3 * event.self_cpu_time_total / rounds for event in found.key_averages()}
    whole = sum(own.values())
    names = sorted(own, key=lambda name: -own[name])
    rows = [*((name, own[name]) for name in names[:SHOWN]), ("others", sum(own[n] for n in names[SHOWN:]))]
    return [{"operation": name, "ms": ms, "%": 100 * ms / whole} for name, ms in rows]


def _config(kind: type, spec: MethodSpec) -> Any:
    preset = {name: value for name, value in spec.presets["demo"].items() if name != "budget"}
    return build(kind, preset, f"preset demo of {spec.name}")


def _bound(clip: MemoryClip, count: int, kind: type, spec: MethodSpec, appearance: Any) -> SplatTrainer:
    mesh = SubjectMesh(clip.head, clip.shape, clip.static_offset, "cpu")
    faces, generator, config = len(mesh.faces), torch.Generator().manual_seed(0), _config(kind, spec)
    means = torch.randn(count, 3, generator=generator) * torch.tensor([0.25, 0.02, 0.25])
    start = Start(torch.arange(count) * faces // count, means, torch.full((count,), 0.5))
    sampler = ShuffledEpochs(len(clip.splits["train"]), 0)
    drawn = appearance(mesh, clip, config, "cpu", 0)
    training = BoundTraining(clip, config.splats, drawn, sampler, faces, "cpu", 0, start=start)
    size = 0.4 * (faces / count) ** 0.5
    with torch.no_grad():
        training.optimiser["log_scales"].copy_(torch.tensor([size, 0.2 * size, size]).log().expand(count, 3))
    return training


def _blendshapes(clip: MemoryClip, count: int) -> SplatTrainer:
    config = replace(_config(GBSConfig, GBS), samples=count, sample_spacing=0.0)
    sampler = ShuffledEpochs(len(clip.splits["train"]), 0)
    return GBSTraining(clip, config, Subject.of(clip), procedural_head("2020"), sampler, "cpu", 0)


METHODS: Mapping[str, Callable[[MemoryClip, int], SplatTrainer]] = {
    "ga": lambda clip, count: _bound(clip, count, GAConfig, GA, GAAppearance),
    "ours": lambda clip, count: _bound(clip, count, OursConfig, OURS, OursAppearance),
    "gbs": _blendshapes,
}
