"""Content of a capture to be checked, from the files of the GaussianAvatars/VHAP layout or from a clip of another reader.

The reader of the layout collects its errors here instead of raising the first, so that one broken frame does not hide other
faults.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from ...bench.contracts import ByteArray, Camera, HeadPose, IntArray, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.arrays import read_npz
from ...bench.io.files import digest
from ...bench.io.images import ImageInfo, probe_image
from ..clip import CaptureClip, FrameFiles
from ..ga import layout
from ..ga.reader import build_clip, read_content
from ..ga.tracking import Tracking, TrackingReading, check_neutral, pose_to_parameters
from ..ga.transforms import Fault, Faults, FrameEntry
from ..ga.validate import content_digests, digests_of_same_size, sequence_names
from ..head.arrays import HeadArrays
from ..head.model import PosedSubject
from ..images import read_image, read_mask

if TYPE_CHECKING:
    from .settings import LintSettings

OFFSETS = ("static_offset", "dynamic_offset")
"""Arrays with a row per vertex; too large to keep for every timestep."""


INNER = ("mouth_socket", "left_eyeball", "right_eyeball", "teeth")
"""Regions of the head without skin that shows."""


class Slot(NamedTuple):
    """Position of a frame in the grid of a capture."""

    timestep: int
    camera_index: int


@dataclass(frozen=True, eq=False)
class Parameters:
    """One parameter file."""

    timestep: int
    path: Path
    arrays: Mapping[str, np.ndarray]
    """Stored arrays without the per-vertex `OFFSETS`; empty if the file cannot be read."""
    not_finite: tuple[str, ...] = ()
    """Names of arrays with NaN or infinite numbers."""
    offset_change_m: float = 0.0
    """Largest difference of its static offset from the first file's; 0 without one."""
    dynamic_m: float = 0.0
    """Largest entry of its dynamic offset; 0 without one."""
    pose: HeadPose | None = None
    """None if the head is unknown or the arrays do not fit it."""
    error: InputError | None = None
    """Why there is no pose."""


class TrackedSubject(PosedSubject):
    """The head with the identity of the first readable timestep, with teeth if its files have them."""

    def __init__(self, tracking: Tracking) -> None:
        super().__init__(tracking.head, tracking.shape, tracking.static_offset)
        self.head = tracking.head

    @cached_property
    def skin(self) -> IntArray:
        """Vertices of the face without eyeballs and mouth, whose colours can be compared; sorted."""
        regions = self.head.regions
        inner = [regions.get(name, np.empty(0, np.int64)) for name in INNER]
        return np.setdiff1d(regions.get("face", np.arange(len(self.head.template))), np.concatenate(inner))


@dataclass(frozen=True)
class Pixels:
    """Source of the pixels of frames; both functions raise `InputError` for damaged files."""

    headers: Mapping[Path, ImageInfo]
    """Headers of the existing images and masks, by path."""
    image: Callable[[FrameEntry], ByteArray]
    """Function from a frame to its image (H, W, 3) on the background."""
    mask: Callable[[FrameEntry], ByteArray | None]
    """Function from a frame to its mask (H, W); None without a mask of the image's size."""


@dataclass(frozen=True, eq=False)
class Capture:
    """Declarations and content of a capture, as far as it could be read."""

    folder: Path
    settings: LintSettings
    of_layout: bool
    """Whether it is a capture of the GaussianAvatars/VHAP layout."""
    background: tuple[float, ...]
    """Declared colour, else white."""
    cy: layout.CyConvention
    """Convention of the entries' intrinsics."""
    convention: layout.CyConvention | None
    """The requested convention, else the declared one; None without either."""
    splits: Mapping[str, Sequence[FrameEntry]]
    """Frames that could be read, by split."""
    pixels: Pixels
    parameters: Mapping[int, Parameters]
    """Tracked parameters by timestep."""
    subject: TrackedSubject | None
    """Head and identity that fit the parameters; None if no file fits."""
    declaration: layout.Declaration | None = None
    """Its ``headbench.json``; None if it is missing or invalid."""
    faults: Faults = field(default_factory=Faults)
    """Errors of the reader."""
    before_run: bool = False
    """Whether to measure only what the errors need that are searched for before a run: digests of image files that have
    the same size as one of another split, fewer views and timesteps."""
    progress: Progress = no_progress

    @classmethod
    def of_files(cls, folder: Path, settings: LintSettings, progress: Progress) -> Self:
        """A capture of the GaussianAvatars/VHAP layout with any errors."""
        faults = Faults(collect=True)
        content = read_content(folder, settings.head, faults=faults, progress=progress)
        parameters, tracking = _read_parameters(content.parameter_files, content.head, faults, progress)
        if tracking is not None and not faults:
            with faults.of("check"):
                build_clip(content, tracking, cy=settings.cy, leaks="record", progress=progress)
        declaration = content.declaration
        declared = declaration.cy if declaration else None
        convention = settings.cy if settings.cy != "auto" else declared
        background = declaration.background if declaration else (1.0, 1.0, 1.0)
        return cls(
            folder=folder,
            settings=settings,
            of_layout=True,
            background=background,
            cy=convention or "bottom",
            convention=convention,
            splits=content.splits,
            pixels=Pixels(
                content.infos,
                lambda entry: read_image(entry.image, background),
                partial(_read_mask, content.infos),
            ),
            parameters=parameters,
            subject=TrackedSubject(tracking) if tracking else None,
            declaration=declaration,
            faults=faults,
            progress=progress,
        )

    @classmethod
    def of_clip(
        cls,
        folder: Path,
        clip: CaptureClip,
        settings: LintSettings,
        progress: Progress,
        *,
        before_run: bool = False,
    ) -> Self:
        """A capture of any reader from its clip, without the layout's files. With ``before_run``, what the reader of
        the GaussianAvatars/VHAP layout recorded is used as well."""
        steps = [step.parameters for step in clip.steps if before_run and step.name == "read_capture"]
        requested = settings.cy if settings.cy != "auto" else None
        convention: layout.CyConvention | None = steps[0]["cy"] if steps else requested
        cy: layout.CyConvention = steps[0]["cy"] if steps else "top"
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
        entries, headers, keys = {}, {}, {}
        for key in [key for split in clip.splits.values() for key in split]:
            # The key stands in for a file whose pixels are not those of the frame.
            files = clip.files[key] if before_run or not clip.pixel_steps else FrameFiles(None, None)
            info = ImageInfo(clip.cameras[key.camera].width, clip.cameras[key.camera].height, 3)
            image, mask = files.image or Path(str(key)), None
            headers[image], keys[image] = info, key
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
        parameters = {}
        for timestep, pose in clip.poses.items():
            arrays = pose_to_parameters(pose)
            parameters[timestep] = Parameters(timestep, folder, arrays, _not_finite(arrays), pose=pose)
        return cls(
            folder=folder,
            settings=settings,
            of_layout=bool(steps),
            background=tuple(clip.background.tolist()),
            cy=cy,
            convention=convention,
            splits={name: tuple(entries[key] for key in split) for name, split in clip.splits.items()},
            pixels=Pixels(
                headers,
                lambda entry: clip.image(keys[entry.image]),
                lambda entry: clip.mask(keys[entry.image]),
            ),
            parameters=parameters,
            subject=TrackedSubject(Tracking(clip.head, clip.poses, clip.shape, clip.static_offset)),
            before_run=before_run,
            progress=progress,
        )

    @property
    def headers(self) -> Mapping[Path, ImageInfo]:
        """Headers of the existing images and masks, by path."""
        return self.pixels.headers

    @cached_property
    def entries(self) -> tuple[FrameEntry, ...]:
        """Frames of all splits."""
        return tuple(entry for entries in self.splits.values() for entry in entries)

    @cached_property
    def imaged_entries(self) -> list[FrameEntry]:
        """Frames with an existing image."""
        return [entry for entry in self.entries if entry.image in self.headers]

    @cached_property
    def unread(self) -> frozenset[Slot]:
        """Slots of frames listed in a JSON that could not be read."""
        return frozenset().union(*(_slot(fault.content) for fault in self.faults if fault.kind == "frame"))

    @cached_property
    def file_faults(self) -> list[InputError]:
        """Errors of missing and damaged images and masks."""
        paths = {path for entry in self.entries for path in (entry.image, entry.mask) if path is not None}
        errors = []
        for path in sorted(paths - self.headers.keys()):
            try:
                probe_image(path)
            except InputError as error:
                errors.append(error)
            except ValueError as error:  # an impossible file name
                errors.append(InputError(path, "", "an image file", str(error)))
        return errors

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
        timesteps: dict[str, set[int]] = defaultdict(set)
        for entry in self.entries:
            timesteps[entry.sequence_folder].add(entry.timestep)
        return {folder: tuple(sorted(numbers)) for folder, numbers in timesteps.items()}

    @cached_property
    def posed(self) -> Sequence[Parameters]:
        """Parameters with a pose."""
        return [parameters for parameters in self.parameters.values() if parameters.pose is not None]

    def pose(self, timestep: int) -> HeadPose | None:
        """Pose of a timestep; None if it has none."""
        return self.parameters[timestep].pose if timestep in self.parameters else None

    def camera(self, entry: FrameEntry) -> Camera:
        """Camera of a frame from its entry, in the world of its sequence."""
        info = self.headers[entry.image]
        intrinsics = layout.intrinsics_from_json(entry.intrinsics, info.width, info.height, self.cy)
        extrinsics = layout.extrinsics_from_json(entry.camera_to_world)
        return Camera(entry.camera_id, info.width, info.height, intrinsics, extrinsics)

    @cached_property
    def digests(self) -> Mapping[Path, str]:
        """Content digest of every existing image; of its pixels where no file has the frame's pixels."""
        if self.before_run:
            return digests_of_same_size({name: [e.image for e in s] for name, s in self.splits.items()})
        images = {entry.image: entry for entry in self.imaged_entries}
        digests = content_digests((path for path in images if path.is_file()), progress=self.progress)
        computed = [path for path in images if path not in digests]
        for done, path in enumerate(computed, start=1):
            digests[path] = digest(self.pixels.image(images[path]))
            self.progress(done, len(computed), "reading images")
        return digests

    @cached_property
    def contents(self) -> Mapping[int, Mapping[str, str]]:
        """Digest of each existing image by timestep and camera id."""
        contents: dict[int, dict[str, str]] = defaultdict(dict)
        for entry in self.entries:
            if entry.image in self.digests:
                contents[entry.timestep][entry.camera_id] = self.digests[entry.image]
        return contents


def _slot(frame: Any) -> set[Slot]:
    """Slot of a frame that does not parse; empty if it is unknown."""
    if not isinstance(frame, dict):
        return set()
    timestep, camera = frame.get("timestep_index"), frame.get("camera_index", 0)
    return {Slot(timestep, camera)} if isinstance(timestep, int) and isinstance(camera, int) else set()


def _read_parameters(
    files: Mapping[int, Path], head: HeadArrays | None, faults: Faults, progress: Progress
) -> tuple[dict[int, Parameters], Tracking | None]:
    """Parameters by timestep, and the tracking of those that fit the head model; None if none does."""
    parameters: dict[int, Parameters] = {}
    reading = TrackingReading(head, "") if head is not None else None
    first_offset: np.ndarray | None = None
    for done, (timestep, path) in enumerate(sorted(files.items()), start=1):
        progress(done, len(files), "reading parameters")
        try:
            arrays = read_npz(path)
        except InputError as error:
            faults.append(Fault("parameters", error, None))
            parameters[timestep] = Parameters(timestep, path, {}, error=error)
            continue
        offset = _numbers(arrays.get("static_offset"))
        first_offset = offset if first_offset is None else first_offset
        misfit = _add(reading, timestep, path, arrays, faults) if reading else None
        parameters[timestep] = Parameters(
            timestep=timestep,
            path=path,
            arrays={name: array for name, array in arrays.items() if name not in OFFSETS},
            not_finite=_not_finite(arrays),
            offset_change_m=_largest(offset - first_offset) if offset.shape == first_offset.shape else 0.0,
            dynamic_m=_largest(_numbers(arrays.get("dynamic_offset"))),
            pose=reading.poses[timestep] if reading and misfit is None else None,
            error=misfit,
        )
    return parameters, reading.tracking() if reading and reading.poses else None


def _add(
    reading: TrackingReading, timestep: int, path: Path, arrays: Mapping[str, np.ndarray], faults: Faults
) -> InputError | None:
    """Add arrays to the tracking; the error if they do not fit, also of an identity that the reader does not use."""
    try:
        shape, static_offset = reading.add(timestep, path, arrays)
    except InputError as error:
        faults.append(Fault("parameters", error, None))
        return None if timestep in reading.poses else error
    try:
        check_neutral(path, reading.head, shape, static_offset)
    except InputError as error:
        return error
    return None


def _not_finite(arrays: Mapping[str, np.ndarray]) -> tuple[str, ...]:
    """Names of the arrays with NaN or infinite numbers."""
    return tuple(name for name, array in arrays.items() if not _is_finite(array))


def _numbers(array: np.ndarray | None) -> np.ndarray:
    """The array if its numbers are finite, else an empty one."""
    usable = array is not None and array.dtype.kind in "fiu" and _is_finite(array)
    return array if array is not None and usable else np.empty(0)


def _is_finite(array: np.ndarray) -> bool:
    return array.dtype.kind not in "f" or bool(np.isfinite(array).all())


def _largest(array: np.ndarray) -> float:
    return float(np.abs(array).max(initial=0.0))


def _read_mask(headers: Mapping[Path, ImageInfo], entry: FrameEntry) -> ByteArray | None:
    info = headers[entry.image]
    path = entry.mask if entry.mask is not None else (entry.image if info.has_alpha else None)
    header = headers.get(path) if path is not None else None
    if path is None or header is None or (header.width, header.height) != (info.width, info.height):
        return None
    return read_mask(path, own=path == entry.image)
