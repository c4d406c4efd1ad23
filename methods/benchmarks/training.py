"""``headbench doctor bench training``: an iteration of each method that trains splats, against the rasteriser's two passes.

Splats lie at random on the procedural head, as training leaves them, and the images are rendered from an untrained avatar,
since the cost of an iteration does not depend on the content.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import cycle, pairwise
from statistics import median
from typing import Any

import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile

from ...bench.configuration import build
from ...bench.contracts import (
    ByteArray,
    Camera,
    FloatArray,
    FrameKey,
    HeadAsset,
    HeadPose,
    Progress,
    StagedAvatar,
    StepRecord,
)
from ...bench.doctor import Row, findings, take_turns
from ...bench.specs import CommandResult, MethodSpec
from ...datasets.head.procedural.model import procedural_head
from ...datasets.steps.clusters import jaw_quaternions
from ..ga.method import GAAppearance, GAAvatar
from ..ga.spec import GA, GAConfig
from ..gbs.method import GBSTraining
from ..gbs.spec import GBS, GBSConfig
from ..ours.appearance import OursAppearance
from ..ours.field import StoredField, initial_parameters, line_box, plane_box
from ..ours.method import OursAvatar
from ..ours.spec import OURS, OursConfig
from ..shared import rendering
from ..shared.avatar_files import Subject
from ..shared.schedule import ShuffledEpochs, Timeline, numpy_generator, torch_generator
from ..shared.splat_training import BoundTraining, SplatTrainer, Start
from ..shared.surface_points import SubjectMesh
from ..shared.threads import torch_threads

DISTANCE = 1.0  # metres, from the camera to the middle of the head
FILL = 0.8  # fraction of the image height covered by the head's mesh


@dataclass(frozen=True, eq=False)
class MemoryClip:
    """A `Clip` in memory, whose images are optional."""

    head: HeadAsset
    shape: FloatArray
    static_offset: FloatArray
    cameras: Mapping[str, Camera]
    poses: Mapping[int, HeadPose]
    splits: Mapping[str, tuple[FrameKey, ...]]
    images: Mapping[FrameKey, ByteArray] = field(default_factory=dict)
    background: FloatArray = field(default_factory=lambda: np.ones(3))
    subject: str = "untrained"
    fingerprint: str = ""
    excluded: Mapping[FrameKey, str] = field(default_factory=dict)
    steps: Sequence[StepRecord] = ()

    def image(self, key: FrameKey) -> ByteArray:
        """The picture of a frame."""
        return self.images[key]

    def mask(self, key: FrameKey) -> None:
        """None: there are no masks."""


def untrained(
    count: int, width: int, height: int, *, version: str = "2020", cameras: int = 4, timesteps: int = 8
) -> tuple[MemoryClip, OursAvatar]:
    """A capture without images of the procedural head, and an avatar of `ours` with ``count`` splats on it."""
    head = procedural_head(version)
    rig = {camera.id: camera for camera in cameras_around(head, cameras, width, height)}
    poses = {
        number: replace(pose, timestep=number, subject="untrained")
        for number, pose in enumerate(random_poses(head, timesteps))
    }
    keys = tuple(FrameKey("untrained", "EMO-1", timestep, camera) for timestep in poses for camera in rig)
    shape, offset = np.zeros(head.shape_basis.shape[2], np.float32), np.zeros(head.template.shape, np.float32)
    clip = MemoryClip(head, shape, offset, rig, poses, {"train": keys})
    return clip, untrained_avatar(head, count)


def with_images(clip: MemoryClip, avatar: OursAvatar) -> MemoryClip:
    """The capture with pictures of an avatar."""
    images = {
        key: np.rint(255 * avatar.render(clip.cameras[key.camera], clip.poses[key.timestep]).rgb)
        for key in clip.splits["train"]
    }
    return replace(clip, images={key: image.astype(np.uint8) for key, image in images.items()})


def untrained_avatar(head: HeadAsset, count: int) -> OursAvatar:
    """Splats spread over the triangles like trained ones: flat, and smaller if there are more."""
    config = OursConfig()
    subject = Subject(
        "untrained",
        head.version,
        np.zeros(head.shape_basis.shape[2], np.float32),
        np.zeros(head.template.shape, np.float32),
    )
    mesh = SubjectMesh(head, subject.shape, subject.static_offset, "cpu")
    rng = torch_generator(0, "untrained")

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=rng)

    faces = len(head.faces)
    binding = torch.arange(count) * faces // max(count, 1)
    size = 0.4 * (faces / max(count, 1)) ** 0.5 * torch.exp(0.5 * normal(count, 1))
    table = torch.cat(
        [
            normal(count, 3) * torch.tensor([0.25, 0.02, 0.25]),
            0.4 + 1.8 * normal(count, 1),
            torch.cat([size, 0.2 * size, size], dim=1).log(),
            torch.tensor([1.0, 0, 0, 0]) + 0.2 * normal(count, 4),
            binding[:, None].float(),
        ],
        dim=1,
    )
    expressions = min(config.lines.expressions, head.expression_basis.shape[2])
    poses = random_poses(head, config.lines.jaw_bases, seed=1)
    tensors = {
        name: value for name, (value, _) in initial_parameters(config, expressions, len(poses), rng).items()
    }
    if "lines" in tensors:
        tensors["lines"] = 0.05 * normal(*tensors["lines"].shape)
    tensors |= {
        "splats": table,
        "plane_box": torch.stack(list(plane_box(mesh.canonical, config.planes.bounds_variant))),
        "line_box": torch.stack(list(line_box(mesh.canonical))),
        "jaw_bases": torch.from_numpy(jaw_quaternions(poses).astype(np.float32)),
    }
    return OursAvatar([], mesh, subject, StoredField(tensors, config.lines.dynamic), "cpu")


def random_poses(head: HeadAsset, count: int, *, seed: int = 0) -> list[HeadPose]:
    """Poses of moderate size, all different."""
    rng = numpy_generator(seed, "poses")
    return [
        HeadPose(
            head.version,
            expression=np.asarray(rng.normal(size=head.expression_basis.shape[2])),
            rotation=0.05 * np.asarray(rng.normal(size=3)),
            neck=0.05 * rng.normal(size=3),
            jaw=np.array([0.1, 0.0, 0.0]) * np.abs(rng.normal(size=1)),
            eyes=0.05 * rng.normal(size=6),
            translation=0.003 * rng.normal(size=3),
            eyelids=None if head.eyelid_basis is None else np.zeros(2),
        )
        for _ in range(count)
    ]


def cameras_around(head: HeadAsset, count: int, width: int, height: int) -> list[Camera]:
    """Cameras on an arc in front of the face, which looks along z with y up; the whole mesh is in view."""
    low, high = head.template.min(0), head.template.max(0)
    middle = 0.5 * (low + high)
    focal = FILL * height * DISTANCE / (high[1] - low[1])
    K = np.array([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1]])
    result = []
    for number, angle in enumerate(np.linspace(-0.6, 0.6, count)):
        forward = -np.array([np.sin(angle), 0.0, np.cos(angle)])
        right = np.cross(forward, [0.0, 1.0, 0.0])
        rotation = np.stack([right, np.cross(forward, right), forward])
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        matrix[:3, 3] = -rotation @ (middle - DISTANCE * forward)
        result.append(Camera(f"{number:02d}", width, height, K, matrix))
    return result


def beside_ga(avatar: OursAvatar) -> GAAvatar:
    """An avatar of `ga` with the splats of one of `ours`, and harmonics of degree 3 at random."""
    splats = {name: getattr(avatar.neutral, name) for name in ("means", "log_scales", "quats")}
    harmonics = 0.2 * torch.randn(len(splats["means"]), 3, 16, generator=torch.Generator().manual_seed(0))
    splats |= {
        "opacities": avatar.neutral.logits,
        "sh_dc": harmonics[:, :, 0],
        "sh_rest": harmonics[:, :, 1:],
    }
    binding = avatar.field.tensors["splats"][:, -1].to(torch.int64)
    return GAAvatar([], avatar.mesh, avatar.subject, splats, binding, None, "cpu")


SIZES = ((20_000, 144, 208), (20_000, 550, 802), (60_000, 550, 802))
QUICK_SIZES = ((2_000, 72, 104),)
FRAMES, QUICK_FRAMES = 50, 3


def avatar_speed(quick: bool, progress: Progress) -> CommandResult:
    """Time whole frames and their stages, a new pose and camera every frame."""
    sizes, rounds = (QUICK_SIZES, QUICK_FRAMES) if quick else (SIZES, FRAMES)
    frames: list[Row] = []
    stages: list[Row] = []
    for number, (count, width, height) in enumerate(sizes):
        progress(number, len(sizes), f"{count} splats, {width}x{height}")
        clip, ours = untrained(count, width, height)
        avatars = {"ours": ours, "ga": beside_ga(ours)}
        size = {"splats": count, "image": f"{width}x{height}"}
        for threads in (1, 2):
            runs = {name: frames_of(avatar, clip) for name, avatar in avatars.items()}
            with torch_threads(threads), torch.no_grad():
                seconds = take_turns(runs, rounds, time.process_time)
            ms = {f"{name} ms": 1e3 * median(each) for name, each in seconds.items()}
            frames.append({**size, "threads": threads, **ms, "ratio": ms["ours ms"] / ms["ga ms"]})
        stages += [
            {**size, "method": name, **stage_times(avatar, clip, rounds)} for name, avatar in avatars.items()
        ]
    note = (
        "Medians of processor ms, all threads together; of frames that take turns, of stages with one thread."
    )
    return findings({"Frames": frames, "Stages": stages}, note)


def frames_of(avatar: StagedAvatar, clip: MemoryClip) -> Callable[[], object]:
    """A function that draws the next frame, with a new pose and a new camera each time."""
    frames = zip(cycle(clip.cameras.values()), cycle(clip.poses.values()))
    return lambda: avatar.render(*next(frames))


def stage_times(avatar: StagedAvatar, clip: MemoryClip, rounds: int) -> dict[str, float]:
    """Medians of the stages that the avatar reports, in ms of one thread."""
    taken: defaultdict[str, list[float]] = defaultdict(list)
    marks: list[tuple[str, float]] = []

    def mark(name: str) -> None:
        marks.append((name, time.thread_time()))

    frames = zip(cycle(clip.cameras.values()), cycle(clip.poses.values()))
    with torch_threads(1), torch.no_grad():
        for _ in range(rounds):
            marks.clear()
            mark("begin")
            avatar.read_back(avatar.draw(*next(frames), (1.0, 1.0, 1.0), mark))
            mark("read back")
            for (_, before), (name, after) in pairwise(marks):
                taken[name].append(after - before)
    return {name: 1e3 * median(values) for name, values in taken.items()}


SIZE = (144, 208)  # of the demo's images
SPLATS = 20_000  # the most that the demo's preset allows
QUICK_SPLATS = 13_000  # above one a triangle
ROUNDS, QUICK_ROUNDS = 30, 5
ITERATION, LENGTH = 1_200, 2_000  # lines and harmonics of every degree are on
SHOWN = 12
"""Operations shown for each method; the others are added up."""


def training_speed(quick: bool, progress: Progress) -> CommandResult:
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
    with profile(activities=[ProfilerActivity.CPU]) as profiler:
        for _ in range(rounds):
            iterate(training)
    milliseconds = {event.key: 1e-3 * event.self_cpu_time_total / rounds for event in profiler.key_averages()}
    whole = sum(milliseconds.values())
    names = sorted(milliseconds, key=lambda name: -milliseconds[name])
    rows = [
        *((name, milliseconds[name]) for name in names[:SHOWN]),
        ("others", sum(milliseconds[n] for n in names[SHOWN:])),
    ]
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
