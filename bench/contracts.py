"""The contracts between the rooms: what a capture, a method, an avatar and a metric are.

Numpy and the standard library only. The behaviours are `Protocol`s, so a plug-in inherits nothing:
it offers these attributes and passes the conformance kit. The values are frozen dataclasses.

Conventions, fixed once here
----------------------------
* Lengths are metres, angles radians, images row-major ``(height, width, channel)``.
* Cameras have OpenCV axes: x right, y down, z forward. ``world_to_camera`` maps world points to camera
  points; ``K`` is in pixels, with the centre of the top left pixel at (0.5, 0.5).
* Colours are display-referred sRGB in [0, 1] unless a name says 8-bit.
* The identity of an image, a render or a row is its `FrameKey`; order in a list never means anything.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating[Any]]
ByteArray = NDArray[np.uint8]
IntArray = NDArray[np.integer[Any]]


# ------------------------------------------------------------------ values


class FrameKey(NamedTuple):
    """Identity of every image, render and row."""

    subject: str
    sequence: str
    timestep: int  # unique within the clip, across its sequences
    camera: str

    def __str__(self) -> str:
        return f"{self.subject}/{self.sequence}/{self.timestep:05d}/{self.camera}"


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera without distortion.

    Attributes
    ----------
    id : name within the clip; keys refer to it.
    width, height : image size, pixels.
    K : (3, 3) float64, pixels. The principal point is honoured by every renderer.
    world_to_camera : (4, 4) float64 rigid motion, metres, OpenCV axes.
    """

    id: str
    width: int
    height: int
    K: FloatArray
    world_to_camera: FloatArray

    @property
    def center(self) -> FloatArray:
        """(3,) position of the camera in the world, metres."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -rotation.T @ translation

    def resized(self, width: int, height: int) -> Camera:
        """The same view at another image size. ``K`` scales without an offset: pixel (0, 0) starts at (0, 0)."""
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return replace(self, width=width, height=height, K=scale @ self.K)

    def boxed(self, left: int, top: int, width: int, height: int) -> Camera:
        """The view of a box of the image, in whole pixels; a box that reaches beyond the image pads it."""
        K = np.array(self.K, dtype=np.float64)
        K[:2, 2] -= left, top
        return replace(self, width=width, height=height, K=K)


@dataclass(frozen=True, eq=False)
class HeadPose:
    """One timestep of the driving signal. Rotations are axis-angle.

    Coefficients belong to one basis: ``head_model`` names it ("flame2020", "flame2023", ...), and those of
    one model mean nothing to another.

    ``subject`` and ``timestep`` say where the signal was recorded. An avatar may use them to find tracking it
    refined in training for that very timestep of its own subject; for any other signal ``timestep`` is None.
    """

    head_model: str
    expression: FloatArray  # (E,)
    rotation: FloatArray  # (3,) about joint 0
    neck: FloatArray  # (3,)
    jaw: FloatArray  # (3,)
    eyes: FloatArray  # (6,) left, then right
    translation: FloatArray  # (3,) metres
    eyelids: FloatArray | None = None  # (2,) left, right; models that have the bases
    subject: str = ""
    timestep: int | None = None


@runtime_checkable
class HeadAsset(Protocol):
    """A head model in FLAME's layout, as arrays. Every size follows from the arrays.

    V vertices, F triangles, S identity and E expression directions, J joints (root, neck, jaw, left eye,
    right eye). Units: metres.
    """

    @property
    def version(self) -> str:
        """Names the expression basis; equals `HeadPose.head_model` of poses that fit."""

    @property
    def template(self) -> FloatArray: ...  # (V, 3)
    @property
    def faces(self) -> IntArray: ...  # (F, 3)
    @property
    def shape_basis(self) -> FloatArray: ...  # (V, 3, S)
    @property
    def expression_basis(self) -> FloatArray: ...  # (V, 3, E)
    @property
    def pose_basis(self) -> FloatArray: ...  # (V, 3, 9 (J-1)); column 9(j-1)+3r+c belongs to (R_j - I)[r, c]
    @property
    def joint_regressor(self) -> FloatArray: ...  # (J, V)
    @property
    def skinning_weights(self) -> FloatArray: ...  # (V, J), rows sum to 1
    @property
    def parents(self) -> IntArray: ...  # (J,), root has -1
    @property
    def eyelid_basis(self) -> FloatArray | None: ...  # (V, 3, 2), added after skinning, turned with the head
    @property
    def regions(self) -> Mapping[str, IntArray]:
        """Vertex indices by region: face, eye_region, lips, scalp, neck, left_eyeball, teeth, ..."""


@dataclass(frozen=True)
class StepRecord:
    """One step that made a clip: its name, its parameters, the fingerprint of its input."""

    name: str
    parameters: Mapping[str, Any]
    input_fingerprint: str


TaskName = Literal["novel_view", "self_reenactment"]


@runtime_checkable
class Clip(Protocol):
    """A prepared capture of one subject. Memory stays bounded however long it is: images are read lazily.

    ``splits`` has "train", "novel_view" (held-out camera, training timesteps) and "self_reenactment"
    (held-out sequence). Keys of different splits never meet.
    """

    @property
    def subject(self) -> str: ...
    @property
    def head(self) -> HeadAsset: ...
    @property
    def shape(self) -> FloatArray: ...  # (S,) identity coefficients
    @property
    def static_offset(self) -> FloatArray:  # (V, 3) metres, added to the shaped template
        ...

    @property
    def cameras(self) -> Mapping[str, Camera]: ...
    @property
    def poses(self) -> Mapping[int, HeadPose]:
        """Tracked pose of each timestep."""

    @property
    def splits(self) -> Mapping[str, tuple[FrameKey, ...]]: ...
    @property
    def excluded(self) -> Mapping[FrameKey, str]:
        """Frames left out of every split, each with its reason."""

    @property
    def background(self) -> FloatArray:  # (3,) in [0, 1]: what images are composited on
        ...

    @property
    def steps(self) -> Sequence[StepRecord]: ...
    @property
    def fingerprint(self) -> str:
        """Hex digest of everything a method can see of this clip."""

    def image(self, key: FrameKey) -> ByteArray:
        """(H, W, 3) 8-bit sRGB, composited on `background`."""

    def mask(self, key: FrameKey) -> ByteArray | None:
        """(H, W) 8-bit foreground coverage, or None where the capture has none."""


@dataclass(frozen=True)
class Budget:
    """How much training may cost: iterations, or seconds, or both (whichever ends first).

    Schedules are fractions of the budget, so that a short run follows the course of a long one. With
    seconds alone the method estimates its iterations from the first steps and says so.
    """

    iterations: int | None = None
    seconds: float | None = None


class Frame(NamedTuple):
    """What an avatar renders."""

    rgb: FloatArray  # (H, W, 3) float32 in [0, 1], composited on the background asked for
    alpha: FloatArray  # (H, W) float32 in [0, 1]


# ------------------------------------------------------------------ behaviours


@runtime_checkable
class Avatar(Protocol):
    """A trained head. It renders any camera and any pose of its head model."""

    def render(self, camera: Camera, pose: HeadPose, background: Sequence[float] = (1.0, 1.0, 1.0)) -> Frame:
        """Render one frame. Raises `InputError` where the pose is not of this avatar's head model."""

    def files(self) -> Sequence[Path]:
        """Files needed to render this avatar and nothing else: what counts as its storage.

        Shared assets (the head model) and the driving signal do not count; the subject's shape does.
        """


class Progress(Protocol):
    """Where long work reports to. A no-op is a valid implementation."""

    def __call__(self, done: int, total: int, note: str = "") -> None: ...


@runtime_checkable
class Method(Protocol):
    """A way of making avatars. Made from its resolved configuration by `MethodSpec.create`."""

    def fit(
        self, clip: Clip, out: Path, budget: Budget, *, device: str, seed: int, progress: Progress
    ) -> Avatar:
        """Train on ``clip.splits["train"]`` alone; write the avatar under ``out``.

        Continues from what an earlier, killed call with the same arguments left in ``out``, and then ends
        with the same avatar as an unbroken one. Raises `InputError` before training where the clip lacks what
        the method needs.
        """

    def load(self, path: Path, *, device: str) -> Avatar:
        """Read an avatar that `fit` wrote to ``path``. Its files are data, never code."""


@runtime_checkable
class Metric(Protocol):
    """One number per frame; never a mean."""

    def __call__(self, image: ByteArray, truth: ByteArray) -> float:
        """Compare two (H, W, 3) 8-bit images. Raises `UnavailableError` where it cannot be had."""


class Measurement(NamedTuple):
    """One number for an avatar as a whole, and what else was learnt in measuring it."""

    value: float
    details: Mapping[str, float]


@runtime_checkable
class AvatarMetric(Protocol):
    """One number per avatar (storage, speed), not per frame."""

    def __call__(self, avatar: Avatar, workload: Sequence[tuple[Camera, HeadPose]]) -> Measurement:
        """Measure an avatar; ``workload`` is a walk over cameras and poses, neighbours always different."""


# ------------------------------------------------------------------ specs: light to import, heavy to create


@dataclass(frozen=True)
class ResolutionRule:
    """The image size that a method works at, as declared by it. Metrics are taken at the protocol's size.

    Applied in this order: square, reduction, enlargement. A capture of 550x802 becomes the 2048x2048 that a method
    for 2K images wants by ``square="pad", size=(2048, 2048)``; one recorded at 2K loses the detail that other
    methods do not see by ``divide=4, multiply=4``.

    Attributes
    ----------
    square : "pad" to the longer side with background, "crop" to the shorter one, or "" for neither; centred.
        What a crop cuts off is scored as background.
    divide : reduce by this factor: block means where it divides both sides, else antialiased bicubic.
    multiply : enlarge by this factor, bicubic.
    size : (width, height) to resize to at the end, antialiased, in place of ``multiply``.
    speed_size : (width, height) at which frames per second are measured; None: the size rendered at.
    """

    square: Literal["", "pad", "crop"] = ""
    divide: int = 1
    multiply: int = 1
    size: tuple[int, int] | None = None
    speed_size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        sides = [self.divide, self.multiply, *(self.size or ()), *(self.speed_size or ())]
        if min(sides) < 1 or self.square not in ("", "pad", "crop"):
            raise ValueError(
                f"{self}: factors and sides are whole numbers from 1, square is pad, crop or nothing"
            )
        if self.size is not None and self.multiply != 1:
            raise ValueError(f"{self}: give multiply or size, not both")

    @property
    def native(self) -> bool:
        """Whether images stay as they are."""
        return self.divide == self.multiply == 1 and not self.square and self.size is None


@dataclass(frozen=True)
class MethodSpec:
    """What listing a method needs. Loading a spec imports neither torch nor the implementation.

    Attributes
    ----------
    name : as typed on the command line and shown in tables.
    summary : one sentence.
    implementation : "package.module:Class"; the class takes the resolved configuration.
    config : "package.module:Class" of the frozen dataclass with its settings, or "" for a method without any.
    presets : settings by preset name. The key "budget" holds `Budget` fields; the rest are config fields.
    head_models : versions the method accepts; empty means any.
    monocular : needs the views as one video, one frame at a timestep, the head's rigid motion in the cameras.
    resolution : the image size it works at.
    native : runs on our own implementation; False for an adapter to an official repository.
    source : the paper.
    trivial : a floor that every real method should beat; shown in tables, never ranked.
    """

    name: str
    summary: str
    implementation: str
    config: str = ""
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    head_models: tuple[str, ...] = ()
    monocular: bool = False
    native: bool = True
    version: str = "1"
    source: str = ""
    trivial: bool = False
    resolution: ResolutionRule = ResolutionRule()


@dataclass(frozen=True)
class MetricSpec:
    """What a table needs to know of a metric.

    ``implementation`` is "package.module:function" of a `Metric`, or of an `AvatarMetric` where ``per_frame``
    is False; a class there is made without arguments.
    """

    name: str
    label: str
    unit: str
    higher_is_better: bool
    digits: int
    implementation: str
    summary: str = ""
    per_frame: bool = True


@dataclass(frozen=True)
class DatasetSpec:
    """A reader: ``implementation`` names a function ``(path, **settings) -> Clip``.

    ``find`` names a function ``(root) -> list of paths`` that lists the captures under a folder. A reader with
    a keyword ``progress`` is given a `Progress`. ``reads`` is False for one that makes captures instead: its
    function takes ``out`` and settings and writes what another reader reads.

    ``adapt`` names a function that brings clips into the form a method needs, see `adaptation`; "" for none.
    """

    name: str
    summary: str
    implementation: str
    find: str = ""
    reads: bool = True
    adapt: str = ""


@dataclass(frozen=True)
class ReportSpec:
    """A view of stored results: ``implementation`` names a function ``(run_folder) -> files written``.

    Every such report is written at the end of a run. ``writes`` is False for one that returns text for printing
    instead, ``(run_folder, format) -> text``.
    """

    name: str
    summary: str
    implementation: str
    writes: bool = True


class Findings(NamedTuple):
    """What a benchmark of the toolkit itself, or a command that a room offers, found out."""

    text: str
    """Tables for a terminal."""
    data: Mapping[str, Any]
    """The same as plain values, for JSON."""
    passed: bool = True
    """False where something did not behave as expected."""


@dataclass(frozen=True)
class BenchmarkSpec:
    """Measurements of a part of the toolkit itself, as opposed to those of avatars.

    ``speed``, ``tradeoffs`` and ``stress`` each name a function ``(quick, progress) -> Findings``, or are "" where
    there is none: how fast it is, what settings that give up accuracy for speed buy, how it behaves at extremes.
    """

    name: str
    summary: str
    speed: str = ""
    tradeoffs: str = ""
    stress: str = ""


@dataclass(frozen=True)
class CommandSpec:
    """A command of the command line that a room offers.

    ``name`` may have two words ("prepare nersemble"). ``settings`` names a frozen dataclass in a module that is
    light to import; its attributes, described in its docstring, become the options. ``implementation`` names a
    function ``(settings, progress) -> Findings``; the exit code is 0, or 1 where it did not pass.
    """

    name: str
    summary: str
    implementation: str
    settings: str


def no_progress(done: int, total: int, note: str = "") -> None:
    """Report to nobody."""
