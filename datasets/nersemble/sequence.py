"""One recorded sequence: frames of each camera, checked before anything is decoded.

Truncated mp4 files are detected by their boxes, which start with their size (ISO/IEC 14496-12, 4.2): a truncated file
either lacks its index (``moov``) or has a box that extends beyond the end.
"""

from __future__ import annotations

import os
import re
import struct
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO, Literal

import cv2

from ...bench.errors import InputError
from ...bench.io.files import entries
from ...bench.io.images import probe_image
from ..lint.rules import spans
from .names import numbered, serial_of
from .recording import Calibration, Participant

Source = Literal["auto", "video", "images"]
"""Source of the frames: videos, or images beside them; "auto" uses images if they come with masks."""

EVERY_OF_73 = 3
"""Every third frame of 73 per second gives the 24.33 frames per second of "24 fps"."""

_TRUNCATED = "Fetch the file again."
_FRAME_FOLDER = re.compile(r"frame_(\d+)")
_IMAGE_FOLDERS = ("images-2x", "images-2x-73fps")
_MASK_FOLDERS = ("alpha_map", "alpha_map-73fps")
_IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True, eq=False)
class RecordedView:
    """The recording of one camera."""

    serial: str
    """Serial number of the camera."""
    video: Path | None = None
    """The video, or None if the frames are image files."""
    images: Mapping[int, Path] = field(default_factory=dict)
    """Image file by frame number; empty for a video."""
    count: int = 0
    """Number of frames."""
    size: tuple[int, int] = (0, 0)
    """(width, height)."""
    mask_video: Path | None = None
    masks: Mapping[int, Path] | None = None
    """Foreground coverage in the same form as the frames, if present."""

    @property
    def has_masks(self) -> bool:
        """Whether every frame has its foreground coverage."""
        return self.mask_video is not None or bool(self.masks)

    @property
    def numbers(self) -> Sequence[int]:
        """Numbers of the frames, ascending."""
        return range(self.count) if self.video else sorted(self.images)

    @property
    def files(self) -> list[Path]:
        """Every file of this view."""
        videos = [path for path in (self.video, self.mask_video) if path]
        return [*videos, *self.images.values(), *(self.masks or {}).values()]


@dataclass(frozen=True, eq=False)
class RecordedSequence:
    """One sequence: its views by serial, all with the same frames, and the selected frames.

    ``numbers`` are frame numbers of the source; timestep t of a prepared capture is ``numbers[t]``. ``uncut`` also has
    selected frames that are skipped because not all cameras have them.
    """

    subject: str
    name: str
    folder: Path
    views: Mapping[str, RecordedView]
    numbers: tuple[int, ...]
    uncut: tuple[int, ...]

    @property
    def has_masks(self) -> bool:
        """Whether all views have masks."""
        return all(view.has_masks for view in self.views.values())


def read_sequence(
    participant: Participant,
    calibration: Calibration,
    wanted: str,
    *,
    cameras: Sequence[str] = (),
    source: Source = "auto",
    every: int | None = None,
    cut: bool = False,
) -> RecordedSequence:
    """Inspect a sequence and check that it is complete.

    ``wanted``: Its name or a unique prefix. ``cameras``: Serials; empty for all cameras of the calibration. ``every``:
    Frame stride: keep the frames whose number it divides. None keeps every third frame of videos and of the 2023 frame
    folders, which have 73 frames per second, and all images of VHAP's preprocessing (25 per second). ``cut``: Whether to
    keep only the frames that all cameras have if they differ, instead of raising an error.
    """
    name = participant.match(wanted)
    folder = participant.sequences[name]
    serials = [*cameras] or calibration.serials
    unknown = [serial for serial in serials if serial not in calibration.world_to_camera]
    if unknown:
        known = ", ".join(calibration.serials)
        raise InputError(calibration.file, "world_2_cam", f"camera {unknown[0]}", f"cameras {known}")
    views, rate = _collect(folder, serials, source)
    stray = sorted(set(views) - set(calibration.serials))
    if stray:
        remedy = "Name the cameras to use."
        expected = f"cameras that {calibration.file.name} knows"
        found = "a recording of another camera"
        raise InputError(folder, stray[0], expected, found, "" if cameras else remedy)
    views = {serial: _checked(folder, views.get(serial), serial, source) for serial in serials}
    common, everything = _common_numbers(folder, views, cut)
    step = every or rate
    if step < 1:
        raise InputError("command line", "every", "a number from 1", f"{step}")
    return RecordedSequence(
        participant.subject,
        name,
        folder,
        views,
        tuple(n for n in common if n % step == 0),
        tuple(n for n in everything if n % step == 0),
    )


def _collect(folder: Path, serials: Sequence[str], source: Source) -> tuple[dict[str, RecordedView], int]:
    """Unchecked views by serial (sizes unknown), and the frames to keep by default."""
    nested = _frame_folders(folder)
    if nested and source != "video":
        return nested, EVERY_OF_73
    images = _image_views(*(_numbered(folder / kind, serials) for kind in ("images", "alpha_maps")))
    with_masks = bool(images) and all(view.masks for view in images.values())
    if images and (source == "images" or (source == "auto" and with_masks)):
        return images, 1
    videos = _videos(folder)
    if videos and source != "images":
        return videos, EVERY_OF_73
    if images and source == "auto":
        return images, 1
    expected = "cam_SERIAL.mp4, images/cam_SERIAL.mp4, images/cam_SERIAL_000000.jpg or frame_00000/images-2x"
    if source != "auto":
        expected += f", as source={source} asks"
    raise InputError(folder, "", expected, "none of them")


def _videos(folder: Path) -> dict[str, RecordedView]:
    views: dict[str, RecordedView] = {}
    for parent in (folder, folder / "images"):
        for path in sorted(parent.glob("cam_*.mp4")):
            if serial := serial_of(path.stem, "cam"):
                mask = folder / "alpha_maps" / path.name
                views[serial] = RecordedView(serial, path, mask_video=mask if mask.exists() else None)
    return views


def _image_views(
    images: Mapping[str, dict[int, Path]], masks: Mapping[str, dict[int, Path]]
) -> dict[str, RecordedView]:
    return {
        serial: RecordedView(serial, images=files, count=len(files), masks=masks.get(serial))
        for serial, files in images.items()
    }


def _numbered(folder: Path, serials: Sequence[str]) -> dict[str, dict[int, Path]]:
    """Files of VHAP's preprocessing, which omits the serial for a single camera."""
    frames: dict[str, dict[int, Path]] = {}
    for path in entries(folder):
        parsed = numbered(path.stem) if path.suffix.lower() in _IMAGE_SUFFIXES else None
        if parsed is None:
            continue
        serial = parsed[0] or (serials[0] if len(serials) == 1 else "")
        if not serial:
            expected = "names with a serial, cam_SERIAL_000000, or one camera to give them to"
            raise InputError(path, "", expected, f"{len(serials)} cameras", "Name the camera they are of.")
        frames.setdefault(serial, {})[parsed[1]] = path
    return frames


def _frame_folders(folder: Path) -> dict[str, RecordedView]:
    """Views of the 2023 release: a folder per frame."""
    images: dict[str, dict[int, Path]] = {}
    masks: dict[str, dict[int, Path]] = {}
    for frame in sorted(folder.glob("frame_*")):
        match = _FRAME_FOLDER.fullmatch(frame.name)
        if match is None:
            continue
        for names, target in ((_IMAGE_FOLDERS, images), (_MASK_FOLDERS, masks)):
            for path in (path for name in names for path in sorted((frame / name).glob("cam_*.png"))):
                if serial := serial_of(path.stem, "cam"):
                    target.setdefault(serial, {})[int(match[1])] = path
    return _image_views(images, masks)


def _checked(folder: Path, view: RecordedView | None, serial: str, source: Source) -> RecordedView:
    """The view with its size and count, from the headers of all files."""
    if view is None:
        kind = "a video" if source == "video" else "frames"
        remedy = "Fetch them, or name the cameras to use."
        expected = f"{kind}, as the calibration has this camera"
        raise InputError(folder, f"camera {serial}", expected, "none", remedy)
    if view.video is not None:
        count, size = probe_video(view.video)
        if view.mask_video is not None:
            _same_mask(view.mask_video, probe_video(view.mask_video), (count, size))
        return replace(view, count=count, size=size)
    size = _image_size(view.images.values())
    if view.masks:
        missing = sorted(set(view.images) - set(view.masks))
        if missing:
            path = view.images[missing[0]]
            raise InputError(path, "", f"a mask for each of {view.count} images", f"{len(missing)} without")
        masks = {number: view.masks[number] for number in view.images}
        _image_size(masks.values(), size)
        return replace(view, size=size, masks=masks)
    return replace(view, size=size)


def probe_video(path: Path) -> tuple[int, tuple[int, int]]:
    """Frames that a video's index declares, and (width, height). Raises `InputError` for a broken file."""
    check_boxes(path)
    capture = open_video(path)
    try:
        count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        size = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
    finally:
        capture.release()
    if count < 1 or min(size) < 1:
        raise InputError(path, "", "a video with frames", f"{count} frames of {size[0]}x{size[1]} pixels")
    return count, size


def open_video(path: Path) -> cv2.VideoCapture:
    """Open a video on one decoding thread, since streams run in parallel. Pixels are read as stored, without the
    rotation in the file's metadata."""
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    if not capture.isOpened():
        raise InputError(path, "", "a video that OpenCV can decode", "one it cannot open")
    return capture


def _image_size(files: Iterable[Path], wanted: tuple[int, int] | None = None) -> tuple[int, int]:
    """The size of all files. ``wanted`` is the size of the images of masks; without it the most frequent size is
    expected, so that an error names the deviating file."""
    sizes = {path: (info.width, info.height) for path in files for info in (probe_image(path),)}
    size = wanted or Counter(sizes.values()).most_common(1)[0][0]
    for path, found in sizes.items():
        if found != size:
            whose = "the camera's images" if wanted else "other images of this camera"
            expected = f"{size[0]}x{size[1]} pixels, as {whose}"
            remedy = "Make masks of the very frames." if wanted else ""
            raise InputError(path, "size", expected, f"{found[0]}x{found[1]}", remedy)
    return size


def _same_mask(path: Path, mask: tuple[int, tuple[int, int]], frames: tuple[int, tuple[int, int]]) -> None:
    for key, found, expected in (("frames", mask[0], frames[0]), ("size", mask[1], frames[1])):
        if found != expected:
            remedy = "Make masks of the very frames."
            raise InputError(path, key, f"{expected}, as the camera's frames", f"{found}", remedy)


def _common_numbers(
    folder: Path, views: Mapping[str, RecordedView], cut: bool
) -> tuple[list[int], list[int]]:
    """Frames of all cameras, and frames of any camera; ascending."""
    numbers = {serial: set(view.numbers) for serial, view in views.items()}
    everything = set.union(*numbers.values())
    common = set.intersection(*numbers.values())
    if len(common) < len(everything) and not cut:
        expected = f"the same frames for all cameras, {len(everything)} as they have together"
        found = _lacking({serial: everything - own for serial, own in numbers.items()})
        remedy = "Fetch the file again, or keep what all cameras have with --cut."
        raise InputError(folder, "frames", expected, found, remedy)
    if not common:
        raise InputError(folder, "frames", "frames that all cameras have", "none")
    return sorted(common), sorted(everything)


def _lacking(missing: Mapping[str, set[int]]) -> str:
    """Missing frames by camera, cameras with the same missing frames together."""
    groups: dict[str, list[str]] = {}
    for serial, numbers in missing.items():
        if numbers:
            groups.setdefault(spans(numbers, limit=8), []).append(serial)
    return "; ".join(
        f"camera{'s' if len(serials) > 1 else ''} {', '.join(serials)} without {listed}"
        for listed, serials in groups.items()
    )


def check_boxes(path: Path) -> None:
    """Raise `InputError` for a file that is missing, no mp4, or cut short. Reads a few bytes per box."""
    try:
        with path.open("rb") as stream:
            kinds = _walk(path, stream)
    except OSError as error:
        raise InputError(path, "", "an mp4 video", error.strerror or str(error)) from error
    for kind in ("moov", "mdat"):
        if kind not in kinds:
            found = f"boxes {', '.join(kinds) or 'none'}"
            raise InputError(path, kind, "a whole mp4 video, with index and frames", found, _TRUNCATED)


def _walk(path: Path, stream: BinaryIO) -> list[str]:
    """Kinds of the top-level boxes."""
    end = os.fstat(stream.fileno()).st_size
    kinds: list[str] = []
    position = 0
    while position < end:
        stream.seek(position)
        header = stream.read(16)
        if len(header) < 8:
            raise InputError(path, "", "a whole mp4 box", f"{len(header)} bytes at the end", _TRUNCATED)
        size, kind = struct.unpack(">I4s", header[:8])
        if size == 1 and len(header) == 16:
            (size,) = struct.unpack(">Q", header[8:])
        elif size == 0:  # the last box, up to the end of the file
            size = end - position
        name = kind.decode("latin-1")
        if not kinds and not name.isprintable():
            raise InputError(path, "", "an mp4 video", f"a file that starts with {header[:8]!r}")
        if size < 8 or position + size > end:
            expected = f"a box {name!r} of {size} bytes" if size >= 8 else "boxes of 8 bytes or more"
            found = f"{end - position} bytes left" if size >= 8 else f"one of {size}"
            raise InputError(path, name, expected, found, _TRUNCATED)
        kinds.append(name)
        position += size
    return kinds
