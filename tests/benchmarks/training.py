"""Processor time of a training iteration by stage, forward and backward, against the rasteriser's in the same run, and
the shares of the processor's multiply-adds and memory bandwidth that are used.

Splats lie at random on the procedural head, as training leaves them, and the images are drawn from an untrained avatar: what an
iteration costs does not depend on what it learns.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

from ...bench.configuration import build
from ...bench.contracts import (
    ByteArray,
    Camera,
    FloatArray,
    FrameKey,
    HeadAsset,
    HeadPose,
    Progress,
    StepRecord,
)
from ...bench.specs import Findings, MethodSpec
from ...datasets.head.procedural.model import procedural_head
from ...methods.ga import method as ga
from ...methods.ga.config import GAConfig
from ...methods.ga.spec import GA
from ...methods.gbs import training as gbs
from ...methods.gbs.config import GBSConfig
from ...methods.gbs.spec import GBS
from ...methods.ops.planes import ColorNetwork, encode, line_position, sum_rows, triplane_features
from ...methods.ours import appearance as ours
from ...methods.ours import field
from ...methods.ours.config import OursConfig
from ...methods.ours.spec import OURS
from ...methods.shared import splat_training
from ...methods.shared.avatar_files import Subject
from ...methods.shared.loop import TrainingImages
from ...methods.shared.optimisation import Densifier, Optimiser
from ...methods.shared.schedule import ShuffledEpochs, Timeline
from ...methods.shared.splat_training import BoundTraining, SplatTrainer, Start
from ...methods.shared.subject_mesh import SubjectMesh
from ...methods.splats.cpu import instruction_sets, peak_flops
from ...methods.splats.request import Rendering
from .avatar.untrained import cameras_around, random_poses, untrained_avatar
from .timing import seconds_of, table, torch_threads

SIZE = (144, 208)  # of the demo's images
SPLATS = 20_000  # the most that the demo's preset allows
QUICK_SPLATS = 13_000  # above one a triangle
CAMERAS, TIMESTEPS = 4, 8
WARM_UP = 4
FIRST_ITERATION, LENGTH = 1_200, 2_000  # lines and harmonics of every degree are on
RASTERISER = "rasterize"


@dataclass(frozen=True, eq=False)
class _Clip:
    """A `Clip` in memory."""

    head: HeadAsset
    shape: FloatArray
    static_offset: FloatArray
    cameras: Mapping[str, Camera]
    poses: Mapping[int, HeadPose]
    splits: Mapping[str, tuple[FrameKey, ...]]
    images: Mapping[FrameKey, ByteArray]
    background: FloatArray
    subject: str = "untrained"
    fingerprint: str = ""
    excluded: Mapping[FrameKey, str] = ()  # type: ignore[assignment]
    steps: Sequence[StepRecord] = ()

    def image(self, key: FrameKey) -> ByteArray:
        return self.images[key]

    def mask(self, key: FrameKey) -> None:
        return None


def _clip(head: HeadAsset, width: int, height: int) -> _Clip:
    avatar = untrained_avatar(head, len(head.faces))
    cameras = {camera.id: camera for camera in cameras_around(head, CAMERAS, width, height)}
    poses = {
        number: replace(pose, timestep=number, subject="untrained")
        for number, pose in enumerate(random_poses(head, TIMESTEPS))
    }
    keys = [FrameKey("untrained", "TRAIN", timestep, camera) for timestep in poses for camera in cameras]
    images = {
        key: np.rint(255 * avatar.render(cameras[key.camera], poses[key.timestep]).rgb).astype(np.uint8)
        for key in keys
    }
    shape, offset = np.zeros(head.shape_basis.shape[2], np.float32), np.zeros(head.template.shape, np.float32)
    return _Clip(head, shape, offset, cameras, poses, {"train": tuple(keys)}, images, np.ones(3))


def _config(kind: type, spec: MethodSpec) -> Any:
    preset = {name: value for name, value in spec.presets["demo"].items() if name != "budget"}
    return build(kind, preset, f"preset demo of {spec.name}")


def _bound(clip: _Clip, count: int, name: str) -> SplatTrainer:
    mesh = SubjectMesh(clip.head, clip.shape, clip.static_offset, "cpu")
    faces, generator = len(mesh.faces), torch.Generator().manual_seed(0)
    appearance: splat_training.Appearance
    if name == "ga":
        config = _config(GAConfig, GA)
        appearance = ga.GAAppearance(mesh, clip, config, "cpu", 0)
    else:
        config = _config(OursConfig, OURS)
        appearance = ours.OursAppearance(mesh, clip, config, "cpu", 0)
    means = torch.randn(count, 3, generator=generator) * torch.tensor([0.25, 0.02, 0.25])
    start = Start(torch.arange(count) * faces // count, means, torch.full((count,), 0.5))
    sampler = ShuffledEpochs(len(clip.splits["train"]), 0)
    training = BoundTraining(clip, config.splats, appearance, sampler, faces, "cpu", 0, start=start)
    size = 0.4 * (faces / count) ** 0.5
    with torch.no_grad():
        training.optimiser["log_scales"].copy_(torch.tensor([size, 0.2 * size, size]).log().expand(count, 3))
    return training


def _blendshapes(clip: _Clip, count: int) -> SplatTrainer:
    config = replace(_config(GBSConfig, GBS), samples=count, sample_spacing=0.0)
    sampler = ShuffledEpochs(len(clip.splits["train"]), 0)
    return gbs.GBSTraining(clip, config, Subject.of(clip), clip.head, sampler, "cpu", 0)  # type: ignore[arg-type]


METHODS: Mapping[str, Callable[[_Clip, int], SplatTrainer]] = {
    "ga": lambda clip, count: _bound(clip, count, "ga"),
    "ours": lambda clip, count: _bound(clip, count, "ours"),
    "gbs": _blendshapes,
}


class _Stages:
    """Seconds of the calling thread by stage, and by the backward pass of each."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._open: list[tuple[str, float]] = []

    def begin(self, name: str) -> None:
        self._open.append((name, time.thread_time()))

    def end(self, name: str) -> None:
        if self._open and self._open[-1][0] == name:
            self.seconds[name] += time.thread_time() - self._open.pop()[1]

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, its time taken, and, by marks on what goes in and comes out, that of its backward pass."""

        def run(*arguments: Any, **named: Any) -> Any:
            backward = f"{name}, backward"
            arguments = self._marked(arguments, lambda: self.end(backward))
            self.begin(name)
            found = function(*arguments, **named)
            self.end(name)
            if isinstance(found, Rendering):
                image, alpha = self._marked((found.image, found.alpha), lambda: self.begin(backward))
                return replace(found, image=image, alpha=alpha)
            parts = (found,) if isinstance(found, Tensor) else tuple(found)
            marked = self._marked(parts, lambda: self.begin(backward))
            return marked[0] if isinstance(found, Tensor) else type(found)(*marked)

        return run

    def _marked(self, values: Sequence[Any], event: Callable[[], None]) -> tuple[Any, ...]:
        chosen = [n for n, value in enumerate(values) if isinstance(value, Tensor) and value.requires_grad]
        result = list(values)
        if chosen:
            for place, value in zip(chosen, _Mark.apply(event, *(values[n] for n in chosen))):  # type: ignore[no-untyped-call]
                result[place] = value
        return tuple(result)


class _Mark(torch.autograd.Function):
    """Identity that calls a function when the gradients pass."""

    @staticmethod
    def forward(ctx: Any, event: Callable[[], None], *values: Tensor) -> tuple[Tensor, ...]:
        ctx.event = event
        return tuple(value.view_as(value) for value in values)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        ctx.event()
        return None, *grads


@contextmanager
def _timed_stages(stages: _Stages) -> Iterator[None]:
    # Where planes do not move splats, the planes alone have a gradient: they go in as tensors of their own.
    timed_colors = stages.timed("colours", _colors_of_planes(ours.plane_colors))
    functions = [
        (splat_training, "rasterize", RASTERISER),
        (splat_training, "photometric_loss", "L1 and SSIM"),
        (gbs, "photometric_loss", "L1 and SSIM"),
        (splat_training, "splat_penalties", "penalties"),
        (ga, "to_world", "to world space"),
        (ours, "to_world", "to world space"),
        (ga, "harmonic_colors", "colours"),
        (ours, "line_offsets", "lines"),
        (ours, "directions_to", "directions"),
        (field, "points_on", "canonical positions"),
        (gbs, "apply_pose", "to world space"),
    ]
    plain = [(Optimiser, "step"), (Densifier, "observe"), (TrainingImages, "get")]
    with ExitStack() as entered:
        for owner, name, stage in functions:
            entered.enter_context(patch.object(owner, name, stages.timed(stage, getattr(owner, name))))
        entered.enter_context(patch.object(ours, "plane_colors", partial(_with_planes, timed_colors)))
        for kind, name in plain:
            entered.enter_context(patch.object(kind, name, _method(stages, kind, name)))
        yield


def _with_planes(function: Callable[..., Tensor], *arguments: Any) -> Tensor:
    *places, network = arguments
    return function(*places, *network)


def _colors_of_planes(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    def run(*arguments: Any) -> Tensor:
        return function(*arguments[:3], ColorNetwork(*arguments[3:]))

    return run


def _method(stages: _Stages, kind: type, name: str) -> Callable[..., Any]:
    original, stage = getattr(kind, name), {"step": "Adam", "observe": "densification", "get": "images"}[name]

    def run(*arguments: Any) -> Any:
        stages.begin(stage)
        found = original(*arguments)
        stages.end(stage)
        return found

    return run


@dataclass(frozen=True)
class Limits:
    """What one thread can do at best, measured: floating-point operations and bytes a second."""

    flops: float
    bandwidth: float


TRIAD = 1 << 23  # numbers in each of two arrays, more than caches hold


def measure_limits() -> Limits:
    """Multiply-adds in registers, and a = a + s c over memory, 12 bytes a number.

    The triad of STREAM (McCalpin 1995) with one array read and written: a third one would be read before it is
    overwritten, which its count leaves out.
    """
    flops = peak_flops("cpu") if instruction_sets() else float("nan")
    a, c = torch.ones(2, TRIAD)
    triad = seconds_of(lambda: torch.add(a, c, alpha=2.0, out=a), time.thread_time)
    return Limits(flops, 12 * TRIAD / min(triad() for _ in range(12)))


@dataclass(frozen=True)
class Iteration:
    """Milliseconds of one thread, the least of the iterations; ``stages`` are medians.

    ``operations`` and ``bytes`` are what stages cannot do without, where that is known.
    """

    method: str
    splats: int
    whole: float
    rasteriser: float
    stages: Mapping[str, float]
    operations: Mapping[str, float]
    bytes: Mapping[str, float]

    def shares(self, limits: Limits) -> dict[str, tuple[str, float]]:
        """By stage, which of the limits it is compared with and how much of it is used."""
        compared = (("multiply-add", self.operations, limits.flops), ("memory", self.bytes, limits.bandwidth))
        return {
            stage: (name, amount / (1e-3 * self.stages[stage]) / limit)
            for name, amounts, limit in compared
            for stage, amount in amounts.items()
        }


@torch.no_grad()
def _network_operations(training: SplatTrainer) -> dict[str, float]:
    """Floating-point operations of the two networks of "ours" in an iteration, without units that are off at a splat."""
    seen: dict[str, tuple[Any, ...]] = {}

    def noting(name: str) -> Callable[..., Any]:
        function = getattr(ours, name)

        def run(*arguments: Any) -> Any:
            seen[name] = arguments
            return function(*arguments)

        return run

    with ExitStack() as entered:
        for name in ("plane_colors", "line_offsets"):
            entered.enter_context(patch.object(ours, name, noting(name)))
        training.loss(FIRST_ITERATION, 0)
    positions, directions, box, network = seen["plane_colors"]
    inputs = torch.cat([*triplane_features(network[:3], box, positions), encode(directions)], dim=1)
    on = float((inputs @ network.first.t() > 0).sum())
    hidden, width = network.first.shape
    # Where planes do not move splats, nobody asks for gradients by the directions.
    back = width if positions.requires_grad else width - encode(directions).shape[1]
    counts = {
        "colours": len(positions) * hidden * (width + 3),
        "colours, backward": on * (width + back + 6),
    }
    positions, box, table, layers = seen["line_offsets"]
    place = line_position(box.unit(positions[box.contains(positions)]), len(table) // 3)
    first = torch.relu(sum_rows(table, *place) + layers.bias_0)
    second = first @ layers.weight_1.t() + layers.bias_1 > 0
    places, of_first, of_second = first.numel(), float((first > 0).sum()), float(second.sum())
    outputs, hidden = layers.weight_2.shape
    counts["lines"] = 6 * places + of_first * hidden + places * outputs
    counts["lines, backward"] = 6 * (places + of_first) + of_second * 2 * (hidden + outputs)
    return {stage: 2.0 * count for stage, count in counts.items()}


def measure_iteration(name: str, clip: _Clip, count: int, repeats: int) -> Iteration:
    """Time iterations of one method."""
    training = METHODS[name](clip, count)
    training.begin(Timeline(LENGTH, 600_000))
    whole, by_stage = [], defaultdict(list)
    operations = _network_operations(training) if name == "ours" else {}
    try:
        for number in range(WARM_UP + repeats):
            stages = _Stages()
            start = time.thread_time()
            with _timed_stages(stages):
                _iterate(training, FIRST_ITERATION + number)
            if number >= WARM_UP:
                whole.append(time.thread_time() - start)
                for stage, seconds in stages.seconds.items():
                    by_stage[stage].append(seconds)
    finally:
        training.close()
    medians = {stage: 1e3 * float(np.median(seconds)) for stage, seconds in by_stage.items()}
    medians["rest"] = 1e3 * float(np.median(whole)) - sum(medians.values())
    rasteriser = [
        a + b for a, b in zip(by_stage[RASTERISER], by_stage[f"{RASTERISER}, backward"], strict=True)
    ]
    numbers = sum(group["value"].numel() for group in training.optimiser.state().values() if group["moments"])
    return Iteration(
        *(name, len(training.binding), 1e3 * min(whole), 1e3 * min(rasteriser), medians, operations),
        # Four arrays are read, three of them written.
        bytes={"Adam": 7.0 * 4 * numbers},
    )


def _iterate(training: SplatTrainer, iteration: int) -> None:
    # Rounds of densification, at every hundredth iteration, would change the number of splats.
    training.loss(iteration, iteration % len(training.keys)).backward()
    offset, visible, camera, _ = training._seen
    assert offset.grad is not None
    training._densifier.observe(offset.grad, visible, camera.width, camera.height)
    training.optimiser.step()
    training.optimiser.zero_grad()


def measure(quick: bool, progress: Progress) -> Findings:
    """An iteration of each method that trains splats on a mesh, at the demo's size."""
    clip = _clip(procedural_head("2020"), *SIZE)
    count, repeats = (QUICK_SPLATS, 6) if quick else (SPLATS, 30)
    found = []
    with torch_threads(1):
        limits = measure_limits()
        for number, name in enumerate(METHODS):
            found.append(measure_iteration(name, clip, count, repeats))
            progress(number + 1, len(METHODS), name)
    rows = [
        (
            one.method,
            str(one.splats),
            f"{one.whole:.1f}",
            f"{one.rasteriser:.1f}",
            f"{one.whole / one.rasteriser:.1f}",
        )
        for one in found
    ]
    names = sorted({stage for one in found for stage in one.stages}, key=lambda name: (name == "rest", name))
    stages = [
        (name, *(f"{one.stages[name]:.2f}" if name in one.stages else "-" for one in found)) for name in names
    ]
    shares = [
        (one.method, stage, kind, f"{share:.2f}")
        for one in found
        for stage, (kind, share) in one.shares(limits).items()
    ]
    width, height = SIZE
    text = (
        f"Training at {width}x{height}, processor ms of one thread: an iteration, the least of {repeats}, and the "
        "rasteriser's two passes.\n\n"
        + table(("method", "splats", "iteration", "rasteriser", "ratio"), rows)
        + "\n\nStages, medians.\n\n"
        + table(("stage", *(one.method for one in found)), stages)
        + f"\n\nOf what this thread can do, measured in this run: {limits.flops / 1e9:.0f} Gflop/s of multiply-adds, "
        f"{limits.bandwidth / 1e9:.0f} GB/s of memory.\nUnits that are off at a splat are not counted.\n\n"
        + table(("method", "stage", "limit", "share"), shares)
    )
    data = {
        one.method: {
            "splats": one.splats,
            "iteration_ms": one.whole,
            "rasteriser_ms": one.rasteriser,
            "stages_ms": dict(one.stages),
            "shares": {stage: share for stage, (_, share) in one.shares(limits).items()},
        }
        for one in found
    }
    data["limits"] = {"gflops": limits.flops / 1e9, "gb_s": limits.bandwidth / 1e9}
    return Findings(text, data)
