"""Readable content of a capture and read errors, the input of the linter's checks.

Unlike the reader, which stops at the first fault, this reads frame by frame and file by file and continues after
each fault, so that one broken frame does not hide other faults.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray, FrameKey, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.documents import read_json
from ...bench.io.files import digest
from ...bench.io.images import ImageInfo, probe_image
from ...bench.protocol import evenly_with_ends
from ..clip import CaptureClip, FrameFiles
from ..ga import layout
from ..ga.content_digests import content_digests, digests_of_same_size
from ..ga.layout import CyConvention
from ..ga.tracking import Tracking, find_head
from ..ga.transforms import FrameEntry, parse_frame
from ..ga.validate import sequence_names
from ..ga.writer import pose_to_parameters
from ..head.arrays import HeadArrays
from ..head.geometry import project, vertex_normals
from .camera_table import CameraFacts, measure_cameras
from .mesh import Parameters, TrackedSubject, not_finite, read_parameters
from .settings import LintSettings
from .views import (
    Pixels,
    Thumbnail,
    ViewFacts,
    entry_camera,
    inspect_views,
    make_thumbnails,
    pick_views,
    pixels_of_files,
)

FRAMES = 16
"""Frames to judge by."""

FEWEST_FRAMES, FEWEST_VERTICES = 6, 50
"""Minimum amount of data for a result."""

FACING = 0.5
"""Minimum cosine between a vertex's normal and the direction to the camera."""

MOVES_PX = 0.5
"""Minimum motion of a vertex's projection by expression, for vertices that are compared."""


class ExpressionFit(NamedTuple):
    """Ratio of the variances over time of the face's colours with the expression and with a face at rest.

    ``mean`` and ``median`` compare the mean and the median over ``vertices`` vertices in ``frames`` frames of
    ``camera``: below 1 if the expression explains the images.
    """

    camera: str
    frames: int
    vertices: int
    mean: float
    median: float

    @property
    def ratio(self) -> float:
        """Geometric mean of both: the mean is dominated by the few vertices that move much, the median by the others."""
        return math.sqrt(self.mean * self.median)


@dataclass(frozen=True, eq=False)
class _Picked:
    """Colours that the face's vertices have in one frame."""

    colours: FloatArray  # (F, 3)
    seen: np.ndarray  # (F,)
    pixels: FloatArray  # (F, 2)


def weigh_expression(
    entries: Sequence[FrameEntry],
    views: Sequence[ViewFacts],
    pixels: Pixels,
    subject: TrackedSubject | None,
    parameters: Mapping[int, Parameters],
    cy: CyConvention,
) -> ExpressionFit | None:
    """Compare the expression with a face at rest; None if there are too few data.

    Parameters
    ----------
    entries : Sequence[FrameEntry]
        Frames with existing images.
    views : Sequence[ViewFacts]
        Sample frames; the most frontal camera in them is used.
    """
    camera = _facing_camera(views)
    if subject is None or camera is None:
        return None
    usable = [e for e in entries if e.camera_id == camera and parameters[e.timestep].pose is not None]
    if not usable:
        return None
    usable.sort(key=lambda entry: entry.timestep)
    moving: list[_Picked] = []
    resting: list[_Picked] = []
    for entry in evenly_with_ends(usable, FRAMES):
        pose = parameters[entry.timestep].pose
        if pose is None:
            continue
        try:
            image = pixels.image(entry)
        except InputError:
            continue  # reported as a damaged file
        still = replace(pose, expression=np.zeros_like(pose.expression))
        place = entry_camera(entry, pixels.headers[entry.image], cy)
        for kept, mesh in zip((moving, resting), subject.meshes([pose, still])):
            kept.append(_pick(mesh, subject, place, image))
    return _compare(camera, moving, resting)


def _facing_camera(views: Sequence[ViewFacts]) -> str | None:
    facing: dict[str, list[float]] = {}
    for view in views:
        if view.mesh is not None and view.mesh.depth > 0:
            facing.setdefault(view.entry.camera_id, []).append(view.mesh.facing)
    return max(facing, key=lambda name: float(np.median(facing[name]))) if facing else None


def _pick(vertices: FloatArray, subject: TrackedSubject, camera: Camera, image: ByteArray) -> _Picked:
    points = vertices[subject.skin]
    outward = vertex_normals(vertices, subject.head.faces)[subject.skin]
    towards = camera.center - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    pixels = project(points, camera)
    where = (pixels - 0.5).astype(np.float32)  # OpenCV's pixel centres are at integers
    picked = cv2.remap(image.astype(np.float32), where[:, :1], where[:, 1:], cv2.INTER_LINEAR)
    colours = picked[:, 0].astype(np.float64)
    within = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(axis=1)
    return _Picked(colours, ((outward * towards).sum(axis=1) > FACING) & within, pixels)


def _compare(camera: str, moving: Sequence[_Picked], resting: Sequence[_Picked]) -> ExpressionFit | None:
    if len(moving) < FEWEST_FRAMES:
        return None
    # Only vertices visible in both are compared.
    seen = np.array([one.seen & other.seen for one, other in zip(moving, resting)])
    moved = np.array(
        [np.linalg.norm(one.pixels - other.pixels, axis=1) for one, other in zip(moving, resting)]
    )
    telling = (seen.sum(axis=0) >= FEWEST_FRAMES) & (moved.max(axis=0) >= MOVES_PX)
    if telling.sum() < FEWEST_VERTICES:
        return None
    ours = _variance(moving, seen)[telling]
    rest = _variance(resting, seen)[telling]
    if rest.mean() <= 0 or np.median(rest) <= 0:
        return None  # a face of one colour
    return ExpressionFit(
        camera,
        len(moving),
        int(telling.sum()),
        float(ours.mean() / rest.mean()),
        float(np.median(ours) / np.median(rest)),
    )


def _variance(picked: Sequence[_Picked], seen: np.ndarray) -> FloatArray:
    """(F,) variance of each vertex's colour over the frames in which it is visible, mean over channels."""
    weight = seen[..., None].astype(np.float64)
    colours = np.array([one.colours for one in picked])
    count = np.maximum(weight.sum(axis=0), 1)
    mean = (colours * weight).sum(axis=0) / count
    variance: FloatArray = ((((colours - mean) ** 2) * weight).sum(axis=0) / count).mean(axis=1)
    return variance


THOROUGH_TIMESTEPS = 32
"""Timesteps on which cameras are measured with ``--thorough``."""


FEW_PIXELS, FEWEST_VIEWS = 5_000_000, 12
FEW_SHOTS, FEWEST_TIMESTEPS = 48, 2
"""Before a run, most pixels of the views and most images to measure cameras on, which take a few seconds; and numbers of views
and timesteps that are taken in any case."""


class Slot(NamedTuple):
    """Position of a frame in the grid of a capture."""

    timestep: int
    camera_index: int


@dataclass(frozen=True, eq=False)
class Evidence:
    """Declarations of a capture, and the content of its files.

    Attributes
    ----------
    of_layout : bool
        Whether the files of the GaussianAvatars/VHAP layout were read. Otherwise the data come from
        another reader.
    background : tuple[float, ...]
        Declared colour, else white.
    declaration : layout.Declaration | None
        Its ``headbench.json``; None if it is missing or invalid.
    splits : Mapping[str, tuple[FrameEntry, ...]]
        Frames that could be read, by split.
    unread : frozenset[Slot]
        Slots of frames listed in a JSON that could not be read.
    declaration_faults, json_faults, frame_faults, file_faults, head_faults : Sequence[InputError]
        Reasons why content could not be read.
    pixels : Pixels
        Headers and pixels of the existing images and masks.
    digests : Mapping[Path, str]
        Content digest of every existing image; before a run, see `gather_clip`.
    subject : TrackedSubject | None
        Head and identity that fit the parameters; None if no file fits.
    thumbnails : Sequence[Thumbnail]
        Thumbnails of the images searched for near-duplicates.
    expression_fit : ExpressionFit | None
        How well expressions explain the images; None if that cannot be measured.
    refusal : InputError | None
        Error of the reader; None if it accepts the capture.
    """

    folder: Path
    settings: LintSettings
    of_layout: bool
    background: tuple[float, ...]
    splits: Mapping[str, tuple[FrameEntry, ...]]
    pixels: Pixels
    digests: Mapping[Path, str]
    parameters: Mapping[int, Parameters]
    subject: TrackedSubject | None
    views: Sequence[ViewFacts]
    thumbnails: Sequence[Thumbnail]
    expression_fit: ExpressionFit | None
    cameras: Mapping[str, CameraFacts]
    declaration: layout.Declaration | None = None
    unread: frozenset[Slot] = frozenset()
    declaration_faults: Sequence[InputError] = ()
    json_faults: Sequence[InputError] = ()
    frame_faults: Sequence[InputError] = ()
    file_faults: Sequence[InputError] = ()
    head_faults: Sequence[InputError] = ()
    refusal: InputError | None = None

    @property
    def headers(self) -> Mapping[Path, ImageInfo]:
        """Headers of the existing images and masks, by path."""
        return self.pixels.headers

    @cached_property
    def entries(self) -> tuple[FrameEntry, ...]:
        """Frames of all splits."""
        return tuple(entry for part in self.splits.values() for entry in part)

    def split_file(self, split: str) -> Path:
        """The file that defines a split; the capture for layouts of other readers."""
        return self.folder / layout.SPLIT_FILES[split] if self.of_layout else self.folder

    @cached_property
    def names(self) -> Mapping[str, str]:
        """Sequence name by sequence folder."""
        if not self.of_layout:
            return {entry.sequence_folder: entry.sequence_folder for entry in self.entries}
        return sequence_names(self.entries, self.declaration.sequences if self.declaration else {})

    @cached_property
    def sequences(self) -> Mapping[str, tuple[int, ...]]:
        """Timesteps by sequence folder, sorted."""
        found: dict[str, set[int]] = {}
        for entry in self.entries:
            found.setdefault(entry.sequence_folder, set()).add(entry.timestep)
        return {folder: tuple(sorted(timesteps)) for folder, timesteps in found.items()}

    @cached_property
    def posed(self) -> Sequence[Parameters]:
        """Parameters with a pose."""
        return [parameters for parameters in self.parameters.values() if parameters.pose is not None]

    @cached_property
    def contents(self) -> Mapping[int, Mapping[str, str]]:
        """Digest of each existing image by timestep and camera id."""
        found: dict[int, dict[str, str]] = defaultdict(dict)
        for entry in self.entries:
            if entry.image in self.digests:
                found[entry.timestep][entry.camera_id] = self.digests[entry.image]
        return found


def gather(folder: Path, settings: LintSettings, progress: Progress) -> Evidence:
    """Read all readable content of a capture."""
    declaration, declaration_faults = _read_declaration(folder)
    splits, unread, json_faults, frame_faults = _read_splits(folder)
    entries = [entry for part in splits.values() for entry in part]
    headers, file_faults = _probe(entries, progress)
    images = {entry.image for entry in entries} & headers.keys()
    digests = content_digests(images, progress=progress)
    head, head_faults = _find_head(folder, declaration, settings)
    parameters, subject = read_parameters(entries, head, progress=progress)
    background = declaration.background if declaration else (1.0, 1.0, 1.0)
    cy = settings.cy if settings.cy != "auto" else (declaration.cy if declaration else "bottom")
    pixels = pixels_of_files(headers, background)
    return Evidence(
        folder=folder,
        settings=settings,
        of_layout=True,
        background=background,
        declaration=declaration,
        splits=splits,
        unread=frozenset(unread),
        declaration_faults=declaration_faults,
        json_faults=json_faults,
        frame_faults=frame_faults,
        file_faults=file_faults,
        head_faults=head_faults,
        pixels=pixels,
        digests=digests,
        parameters=parameters,
        subject=subject,
        refusal=_refusal(folder, settings),
        **_looked_at(splits, pixels, background, cy, subject, parameters, settings, progress),
    )


def gather_clip(
    folder: Path, clip: CaptureClip, settings: LintSettings, progress: Progress, *, before_run: bool = False
) -> Evidence:
    """Evidence from a clip of any reader, without the layout's files.

    ``before_run`` takes only what the errors need that are searched for before a run: digests of image files that have
    the same size as one of another split, fewer views and measurements of cameras; no search for near-duplicates and no
    fit of expressions. Of the layout, what its reader recorded is then used as well.
    """
    record = next((step.parameters for step in clip.steps if step.name == "read_capture"), None)
    record = record if before_run else None
    cy: CyConvention = "top" if record is None else record["cy"]
    settings = replace(settings, cy=cy) if record is not None else settings
    rig: dict[str, dict[str, Any]] = {
        name: {
            "camera_index": index,
            "camera_id": name,
            "width": camera.width,
            "height": camera.height,
            "intrinsics": layout.intrinsics_to_json(camera, cy),
            "camera_to_world": np.array(layout.extrinsics_to_json(camera.world_to_camera)),
        }
        for index, (name, camera) in enumerate(clip.cameras.items())
    }
    entries, headers, key_of = {}, {}, {}
    for key in [key for part in clip.splits.values() for key in part]:
        # The key stands in for a file whose pixels are not those of the frame.
        files = clip.files[key] if before_run or not clip.pixel_steps else FrameFiles(None, None)
        info = ImageInfo(clip.cameras[key.camera].width, clip.cameras[key.camera].height, 3)
        image, mask = files.image or Path(str(key)), None
        headers[image], key_of[image] = info, key
        if clip.has_mask(key):
            mask = files.mask or Path(f"{key} mask")
            headers[mask] = info
        entries[key] = FrameEntry(
            file=folder,
            where=f"frame {key}",
            timestep=key.timestep,
            sequence_folder=key.sequence,
            image=image,
            mask=mask,
            parameters=folder,
            **rig[key.camera],
        )
    pixels = Pixels(headers, lambda e: clip.image(key_of[e.image]), lambda e: clip.mask(key_of[e.image]))
    splits = {name: tuple(entries[key] for key in part) for name, part in clip.splits.items()}
    subject = TrackedSubject(Tracking(clip.head, clip.poses, clip.shape, clip.static_offset))
    parameters = {}
    for timestep, pose in clip.poses.items():
        arrays = pose_to_parameters(pose)
        parameters[timestep] = Parameters(timestep, folder, arrays, not_finite(arrays), pose=pose)
    background = tuple(clip.background.tolist())
    return Evidence(
        folder=folder,
        settings=settings,
        of_layout=record is not None,
        background=background,
        splits=splits,
        pixels=pixels,
        digests=digests_of_same_size({name: [e.image for e in part] for name, part in splits.items()})
        if before_run
        else _every_digest(clip, key_of, progress),
        parameters=parameters,
        subject=subject,
        **_looked_at(
            splits, pixels, background, cy, subject, parameters, settings, progress, before_run=before_run
        ),
    )


def _every_digest(clip: CaptureClip, key_of: Mapping[Path, FrameKey], progress: Progress) -> dict[Path, str]:
    """Digest of every image: of its file if its pixels are those of the file."""
    digests = content_digests((path for path in key_of if path.is_file()), progress=progress)
    for done, (path, key) in enumerate(key_of.items(), start=1):
        if path not in digests:
            digests[path] = digest(clip.image(key))
        progress(done, len(key_of), "reading images")
    return digests


def _looked_at(
    splits: Mapping[str, Sequence[FrameEntry]],
    pixels: Pixels,
    background: tuple[float, ...],
    cy: layout.CyConvention,
    subject: TrackedSubject | None,
    parameters: Mapping[int, Parameters],
    settings: LintSettings,
    progress: Progress,
    *,
    before_run: bool = False,
) -> dict[str, Any]:
    """Evidence from decoded frames: fields of `Evidence`."""
    there = {name: [e for e in part if e.image in pixels.headers] for name, part in splits.items()}
    whole = [entry for part in there.values() for entry in part]
    count, timesteps = settings.views, settings.camera_timesteps
    if before_run:
        sizes = {entry.camera_id: (entry.width or 0) * (entry.height or 0) for entry in whole}
        count = min(count, max(FEWEST_VIEWS, FEW_PIXELS // max(1, *sizes.values())))
        timesteps = min(timesteps, max(FEWEST_TIMESTEPS, FEW_SHOTS // max(1, len(sizes))))
    chosen = whole if settings.thorough else pick_views(whole, count)
    views = inspect_views(chosen, pixels, subject, parameters, background, cy, progress=progress)
    limit = len(whole) if settings.thorough else settings.duplicates
    timesteps = THOROUGH_TIMESTEPS if settings.thorough else timesteps
    return {
        "views": views,
        "thumbnails": () if before_run else make_thumbnails(there, pixels.image, limit, progress=progress),
        "expression_fit": None
        if before_run
        else weigh_expression(whole, views, pixels, subject, parameters, cy),
        "cameras": measure_cameras(
            whole, pixels, subject, parameters, cy, timesteps=timesteps, progress=progress
        )
        if timesteps
        else {},
    }


def _read_declaration(folder: Path) -> tuple[layout.Declaration | None, list[InputError]]:
    try:
        return layout.Declaration.read(folder), []
    except InputError as error:
        return None, [error]


def _read_splits(
    folder: Path,
) -> tuple[dict[str, tuple[FrameEntry, ...]], set[Slot], list[InputError], list[InputError]]:
    """Frames by split, slots of frames that do not parse, faults of whole JSONs, faults of frames."""
    files = {name: folder / file for name, file in layout.SPLIT_FILES.items()}
    if not any(path.exists() for path in files.values()):
        files = {"train": folder / layout.ALL_FRAMES_FILE}
    splits: dict[str, tuple[FrameEntry, ...]] = {}
    unread: set[Slot] = set()
    json_faults: list[InputError] = []
    frame_faults: list[InputError] = []
    for name, path in files.items():
        splits[name] = ()
        try:
            document = read_json(path)
        except InputError as error:
            json_faults.append(error)
            continue
        frames = document.get("frames")
        if not isinstance(frames, list):
            json_faults.append(InputError(path, "frames", "a list of frames", type(frames).__name__))
            continue
        entries = []
        for index, frame in enumerate(frames):
            try:
                entries.append(parse_frame(path, f"frames[{index}]", frame, document))
            except InputError as error:
                frame_faults.append(error)
                unread |= _slot(frame)
        splits[name] = tuple(entries)
    return splits, unread, json_faults, frame_faults


def _slot(frame: Any) -> set[Slot]:
    """Slot of a frame that does not parse; empty if it is unknown."""
    if not isinstance(frame, dict):
        return set()
    timestep, camera = frame.get("timestep_index"), frame.get("camera_index", 0)
    return {Slot(timestep, camera)} if isinstance(timestep, int) and isinstance(camera, int) else set()


def _probe(
    entries: Sequence[FrameEntry], progress: Progress
) -> tuple[dict[Path, ImageInfo], list[InputError]]:
    headers: dict[Path, ImageInfo] = {}
    faults: list[InputError] = []
    paths = sorted({path for entry in entries for path in (entry.image, entry.mask) if path is not None})
    for done, path in enumerate(paths, start=1):
        try:
            headers[path] = probe_image(path)
        except InputError as error:
            faults.append(error)
        except ValueError as error:  # an impossible file name
            faults.append(InputError(path, "", "an image file", str(error)))
        progress(done, len(paths), "reading image headers")
    return headers, faults


def _find_head(
    folder: Path, declaration: layout.Declaration | None, settings: LintSettings
) -> tuple[HeadArrays | None, list[InputError]]:
    """The head, also if its version is not the declared one, since its geometry can still be checked."""
    try:
        return find_head(folder, declaration, settings.head), []
    except InputError as error:
        faults = [error]
    if declaration is None:
        return None, faults
    try:
        return find_head(folder, None, settings.head or folder / declaration.head_file), faults
    except InputError:
        return None, faults


def _refusal(folder: Path, settings: LintSettings) -> InputError | None:
    try:
        replace(settings, reader=settings.reader or "ga").open(str(folder), no_progress)
    except InputError as error:
        return error
    return None


def by_camera(entries: Iterable[FrameEntry]) -> dict[str, list[FrameEntry]]:
    """Frames by camera id, cameras in index order."""
    found: dict[str, list[FrameEntry]] = {}
    for entry in sorted(entries, key=lambda e: (e.camera_index, e.timestep)):
        found.setdefault(entry.camera_id, []).append(entry)
    return found


def first_entries(evidence: Evidence) -> dict[str, FrameEntry]:
    """First frame of each camera, in the first sequence that has it."""
    return {camera: frames[0] for camera, frames in by_camera(evidence.entries).items()}
