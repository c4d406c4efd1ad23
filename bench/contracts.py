"""Contracts between the packages for captures, methods, avatars and metrics.

Their registry entries are defined in `specs`.

Only NumPy and the standard library are imported. Behaviours are protocols, so a plug-in inherits nothing:
it provides these attributes and passes the conformance kit. Values are frozen dataclasses.

Conventions
-----------
* Lengths are metres, angles radians, images row-major ``(height, width, channel)``.
* Cameras have OpenCV axes: x right, y down, z forward. ``world_to_camera`` maps world points to camera
  points; ``K`` is in pixels, with the centre of the top left pixel at (0.5, 0.5).
* Colours are display-referred sRGB in [0, 1] unless a name says 8-bit.
* Images, renders and rows are identified by their `FrameKey`; the order of a list has no meaning.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating[Any]]
ByteArray = NDArray[np.uint8]
IntArray = NDArray[np.integer[Any]]
BoolArray = NDArray[np.bool_]


# ------------------------------------------------------------------ values


class FrameKey(NamedTuple):
    """Identity of every image, render and row."""

    subject: str
    sequence: str
    timestep: int  #: unique within the clip, across its sequences
    camera: str

    def __str__(self) -> str:
        return f"{self.subject}/{self.sequence}/{self.timestep:05d}/{self.camera}"


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera without distortion."""

    id: str
    """Name within the clip, used by keys."""
    width: int
    height: int
    """``width``, ``height``: Image size, pixels."""
    K: FloatArray
    """(3, 3) float64, pixels. Every renderer uses the principal point."""
    world_to_camera: FloatArray
    """(4, 4) float64 rigid motion, metres, OpenCV axes."""

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
        """The view of a box of the image, in whole pixels; a box that extends beyond the image pads it."""
        K = np.array(self.K, dtype=np.float64)
        K[:2, 2] -= left, top
        return replace(self, width=width, height=height, K=K)


@dataclass(frozen=True, eq=False)
class HeadPose:
    """One timestep of the driving signal. Rotations are axis-angle.

    Coefficients belong to one basis, named by ``head_model`` ("flame2020", "flame2023", ...). They are
    meaningless for other models.

    ``subject`` and ``timestep`` identify the recording of the signal. An avatar may use them to find tracking
    that it refined in training for the same timestep of its own subject; ``timestep`` is None for any other
    signal.
    """

    head_model: str
    expression: FloatArray  #: (E,)
    rotation: FloatArray  #: (3,) about joint 0
    neck: FloatArray  #: (3,)
    jaw: FloatArray  #: (3,)
    eyes: FloatArray  #: (6,) left, then right
    translation: FloatArray  #: (3,) metres
    eyelids: FloatArray | None = None  #: (2,) left, right; models that have the bases
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
        """Name of the expression basis; equals `HeadPose.head_model` of compatible poses."""

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
    """A prepared capture of one subject. Images are read lazily, so memory does not grow with its length.

    ``splits`` has "train", "novel_view" (held-out camera, training timesteps) and "self_reenactment"
    (held-out sequence). The splits are disjoint.
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


@runtime_checkable
class RegionalClip(Protocol):
    """Optional capability of a clip: locate the parts of the head in a frame."""

    @property
    def region_names(self) -> Sequence[str]: ...
    def region_masks(self, key: FrameKey, names: Sequence[str]) -> Mapping[str, BoolArray]:
        """(H, W) masks of the pixels in which each region is visible; all False if it is not."""


@dataclass(frozen=True)
class Budget:
    """Limit of the training cost: iterations, seconds, or both (whichever ends first).

    Schedules are fractions of the budget, so that a short run follows the course of a long one. With only a
    limit in seconds, the method estimates its iterations, again during the training, and reports the estimate.
    """

    iterations: int | None = None
    """Number of iterations of the training; None for no limit."""
    seconds: float | None = None
    """Time of the training; None for no limit."""


class Frame(NamedTuple):
    """The output of an avatar for one frame."""

    rgb: FloatArray  #: (H, W, 3) float32 in [0, 1], composited on the background asked for
    alpha: FloatArray  #: (H, W) float32 in [0, 1]


# ------------------------------------------------------------------ behaviours


@runtime_checkable
class Avatar(Protocol):
    """A trained head that renders any camera and any pose of its head model."""

    def render(self, camera: Camera, pose: HeadPose, background: Sequence[float] = (1.0, 1.0, 1.0)) -> Frame:
        """Render one frame. Raises `InputError` if the pose belongs to another head model."""

    def files(self) -> Sequence[Path]:
        """Files needed to render this avatar, which count as its storage.

        Shared assets (the head model) and the driving signal do not count; the subject's shape does.
        """


@runtime_checkable
class CodedAvatar(Avatar, Protocol):
    """An avatar that can be stored through a codec, which rounds and compresses its files. Optional."""

    @property
    def codec(self) -> str:
        """Name of the codec that its files went through with its steps; "" for files as they were trained."""


class Variant(NamedTuple):
    """An avatar that can be derived from a trained one without training, such as one with fewer splats."""

    name: str
    """Unique among the variants of an avatar, fit for a folder."""
    summary: str
    """Description of the change."""
    make: Callable[[Path], Avatar]
    """Write its files under a folder and return the avatar as read back from them."""


STAGES = ("drive", "deform", "rasterize", "post")
"""Stages of a frame, in order: driving signal to posed head model; that to primitives as the camera sees them;
primitives to image; whatever changes the image afterwards (a decoder, clipping)."""


@runtime_checkable
class StagedAvatar(Avatar, Protocol):
    """An avatar whose frame can be timed by stage, and rendered before it is read back. Optional.

    Its `render` is ``read_back(draw(camera, pose, background))``.
    """

    def draw(
        self, camera: Camera, pose: HeadPose, background: Sequence[float], end_stage: Callable[[str], None]
    ) -> Any:
        """Render a frame on the avatar's device without waiting for it; `read_back` accepts the result.

        Calls ``end_stage`` with the name of each stage in the order of `STAGES` as soon as its work is
        submitted; stages that the avatar does not have are skipped.
        """

    def read_back(self, drawn: Any) -> Frame:
        """Wait for the result of `draw` and copy it into host memory."""


@runtime_checkable
class DepthAvatar(Avatar, Protocol):
    """An avatar that renders depth. Optional."""

    def depth(self, camera: Camera, pose: HeadPose) -> FloatArray:
        """(H, W) depth along the camera's axis, metres; NaN in pixels that are mostly background."""


@runtime_checkable
class SharingAvatar(Avatar, Protocol):
    """An avatar that needs assets which all avatars of its kind share, such as the head model. Optional."""

    def shared_files(self) -> Sequence[Path]:
        """Files needed besides `files`, the same for every subject; not counted as an avatar's storage."""


class Splats(Protocol):
    """Splats of one pose in the world: float32 arrays of N splats."""

    @property
    def means(self) -> FloatArray: ...  # (N, 3) metres
    @property
    def quats(self) -> FloatArray: ...  # (N, 4) unit, wxyz
    @property
    def scales(self) -> FloatArray: ...  # (N, 3) metres
    @property
    def opacities(self) -> FloatArray: ...  # (N,)
    @property
    def colors(self) -> FloatArray | None: ...  # (N, 3) as a camera sees them


@runtime_checkable
class SplatAvatar(Avatar, Protocol):
    """An avatar of 3D Gaussians. Optional."""

    def splats(self, pose: HeadPose, camera: Camera | None = None) -> Splats:
        """Splats of a pose; with colours if a camera gives the viewpoint."""


@runtime_checkable
class HarmonicAvatar(SplatAvatar, Protocol):
    """An avatar whose splats' colours are spherical harmonics in every pose. Optional.

    Exporters use these coefficients; for other splat avatars they fit coefficients to the colours of `splats`.
    """

    def harmonics(self, pose: HeadPose) -> tuple[FloatArray, FloatArray]:
        """(N, 3) coefficients of degree 0 and (N, 3, K) of higher degrees, K up to 15, float32.

        Directions point from the camera to the splat, in the world. Order, signs and offset are those of
        3D Gaussian Splatting (Kerbl et al., SIGGRAPH 2023).
        """


@runtime_checkable
class ListedFrames(Avatar, Protocol):
    """An avatar that another program renders, with many frames in one call. Optional.

    Its `render` raises `UnavailableError`, so metrics that request single frames (speed, extremes) are
    missing.
    """

    def render_listed(
        self,
        views: Mapping[FrameKey, tuple[Camera, HeadPose]],
        background: Sequence[float],
        progress: Progress,
    ) -> Iterator[tuple[FrameKey, Frame]]:
        """Render exactly these frames; yield each once, with its key, in any order.

        ``alpha`` is 1 if the program does not output coverage. Raises `HeadbenchError` with the last lines of the
        program's output if it fails or leaves a frame out.
        """


class Changes(NamedTuple):
    """What the mechanism of a method (`MethodSpec.mechanism`) makes of N splats, or other primitives, in one pose."""

    values: Mapping[str, FloatArray]
    """(N,) or (N, C) by quantity: "opacity" and "color" in [0, 1], "position" in millimetres. Constant parts, and motion that
    the head model determines, do not matter; empty without the mechanism."""
    penalised: BoolArray | None = None
    """(N,) splats whose changes the training penalises in this pose; None for a method without such a penalty."""


@runtime_checkable
class ChangingAvatar(Avatar, Protocol):
    """An avatar that shows the effect of its method's mechanism. Optional."""

    def changes(self, pose: HeadPose) -> Changes:
        """Values of the same primitives, in the same order, in every pose."""


class Progress(Protocol):
    """Receives the progress of long work. A no-op is a valid implementation."""

    def __call__(self, done: int, total: int, note: str = "") -> None: ...


@runtime_checkable
class Method(Protocol):
    """A training method, created from its resolved configuration by `MethodSpec.create`."""

    def fit(
        self, clip: Clip, out: Path, budget: Budget, *, device: str, seed: int, progress: Progress
    ) -> Avatar:
        """Train on ``clip.splits["train"]`` only; write the avatar under ``out``.

        Resumes from the files that an earlier, killed call with the same arguments left in ``out``, and ends
        with the same avatar as an uninterrupted call. Raises `InputError` before training if the clip lacks
        something that the method needs.
        """

    def load(self, path: Path, *, device: str) -> Avatar:
        """Read an avatar that `fit` wrote to ``path``. Its files are read as data, never as code."""


@runtime_checkable
class CheckedMethod(Method, Protocol):
    """A method that can check the inputs of `fit` before any long work. Optional."""

    def check(self, clip: Clip | None, budget: Budget) -> None:
        """Raise `InputError` for settings that refer to missing files, and for inputs that `fit` would
        refuse.

        It is first called without a clip, before any long work, and then checks everything except the clip.
        """


@runtime_checkable
class PreparedMethod(Method, Protocol):
    """A method that loads or compiles something for a device outside of training. Optional."""

    def prepare(self, device: str) -> None:
        """Load or compile what is needed; the time is not counted as training time.

        Raises `UnavailableError` if that is not possible.
        """


@runtime_checkable
class Metric(Protocol):
    """One number per frame; never a mean.

    A metric that is faster on many frames also offers ``batched(pairs) -> iterator of values``: the values in
    order, the pairs of image and ground truth read lazily. One that can compute on a GPU offers ``on(device) -> metric``.
    """

    def __call__(self, image: ByteArray, target: ByteArray) -> float:
        """Compare two (H, W, 3) 8-bit images.

        Raises an error of any kind for images of another type or of different sizes, and `UnavailableError`
        if the metric is not available.
        """


@runtime_checkable
class RegionalMetric(Metric, Protocol):
    """A metric that can also be computed over a part of the frame (`MetricSpec.kind` "regional")."""

    def in_regions(
        self, image: ByteArray, target: ByteArray, masks: Mapping[str, BoolArray]
    ) -> Mapping[str, float]:
        """Value over each (H, W) mask; masks without pixels are left out."""


class VisibleFaceMetric(Protocol):
    """One number per frame over the visible face (`MetricSpec.kind` "face"). It may offer ``on`` as a `Metric` does."""

    def __call__(self, image: ByteArray, target: ByteArray, face: BoolArray) -> float:
        """Compare two (H, W, 3) 8-bit images; ``face`` is the (H, W) mask of the face's visible pixels.

        Raises `LeftOutError` if the mask shows too little of the face.
        """


@runtime_checkable
class TemporalMetric(Protocol):
    """One number per frame and its neighbour in time, of one camera and sequence (`MetricSpec.kind` "temporal")."""

    def __call__(
        self, image: ByteArray, target: ByteArray, other_image: ByteArray, other_target: ByteArray
    ) -> float:
        """Compare the change of the image between the frames with that of the ground truth; (H, W, 3) 8-bit
        each."""


class SequenceMetric(Protocol):
    """One number for the frames of a sequence from one camera, in temporal order (`MetricSpec.kind` "sequence")."""

    def __call__(self, images: Sequence[ByteArray], targets: Sequence[ByteArray]) -> float:
        """Compare images with the ground truth; (H, W, 3) 8-bit each, one per scored frame."""


class SetMetric(Protocol):
    """One number for all frames of a subject and task, in any order (`MetricSpec.kind` "set")."""

    def __call__(self, pairs: Iterable[tuple[ByteArray, ByteArray]]) -> float:
        """Compare images with the ground truth; pairs of (H, W, 3) 8-bit each, read lazily."""


class Measurement(NamedTuple):
    """One number for an avatar as a whole, and auxiliary values of the measurement.

    Metrics with the same implementation are measured together: `MetricSpec.detail` selects the value of each.
    """

    value: float
    details: Mapping[str, float]


@runtime_checkable
class AvatarMetric(Protocol):
    """One number per avatar (storage, speed), not per frame."""

    def __call__(self, avatar: Avatar, workload: Sequence[tuple[Camera, HeadPose]]) -> Measurement:
        """Measure an avatar; ``workload`` has pairs of a camera and a pose, both different from the previous
        pair's."""


@runtime_checkable
class TrainingMetric(Protocol):
    """One number of how an avatar was trained (time, memory)."""

    def __call__(self, record: Mapping[str, Any]) -> Measurement:
        """Compute it from the record of the fit: ``seconds``, ``interruptions``, ``peak_memory_bytes``,
        ``load``.

        Raises `UnavailableError` if the record lacks the value.
        """


class TrueFrame(NamedTuple):
    """Ground truth of one frame."""

    rgb: ByteArray  #: (H, W, 3) 8-bit sRGB on the clip's background
    mask: ByteArray  #: (H, W) 8-bit foreground coverage
    face: BoolArray  #: (H, W) pixels in which the face is visible
    depth: FloatArray | None = (
        None  #: (H, W) depth of the head along the camera's axis, metres; infinite where there is no head
    )


class GroundTruth(Protocol):
    """Renders the subject of a synthetic capture in any pose and view, see `DatasetSpec.truth`."""

    @property
    def fingerprint(self) -> str:
        """Hex digest of everything that a render depends on besides camera and pose."""

    def render(self, camera: Camera, pose: HeadPose) -> TrueFrame:
        """Render the subject, without depth. Deterministic."""

    def depth(self, camera: Camera, pose: HeadPose) -> FloatArray:
        """Depth of the head, as `TrueFrame.depth`."""


def no_stage(name: str) -> None:
    """Ignore the end of a stage."""


def no_progress(done: int, total: int, note: str = "") -> None:
    """Ignore progress."""
