"""Timesteps in files of trackers, ``checkpoint/00012.frame``: files of ``torch.save`` with dictionaries of arrays.

Images and masks of tracked frames, found by the numbers in their names. A tracked video of a tracker's frames, their
images and a head model.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...bench.contracts import Camera, FloatArray, HeadPose
from ...bench.errors import InputError
from ...bench.io.arrays import Member, check_arrays, read_saved
from ...bench.io.files import entries
from ...bench.io.images import ImageInfo, probe_image
from ..head.arrays import HeadArrays
from ..head.loaders import EYELIDS_REMEDY
from ..monocular.clip import VIDEO, Track, VideoFrame, coefficients, frame_number, ordered

IMAGES = (".jpeg", ".jpg", ".png")
INSIDE, INSIDE_SUFFIX = "parsing", "_neckhead"
"""Folder and ending of the names of FlashAvatar's masks of head and neck."""


@dataclass(frozen=True)
class Layout:
    """Locations of a tracker's images and masks."""

    images: Mapping[str, int | None]
    """Folders of images, the first of which that exists is taken, and the number of the image of frame 0; None takes
    the lowest number in the folder."""
    masks: tuple[str, ...] = ()
    """Folders of masks beside that of the images."""
    labels: str = ""
    """Folder of label images beside that of the images; "" for none."""
    subject: tuple[int, int] = (1, 255)
    """First and last label of the subject."""
    resized: bool = False
    """Whether images may be larger than the ones tracked, with the same ratio of width to height."""


class Picture(NamedTuple):
    """Files of a frame, and the size of the image."""

    image: Path
    mask: Path | None
    inside: Path | None
    info: ImageInfo


@dataclass(frozen=True)
class VideoPictures:
    """Files by frame number. ``masks`` describes the masks, "" if there are none; ``solid`` is `Track.solid`.
    ``unused`` is the number of images without a tracked frame."""

    frames: Mapping[int, Picture]
    folder: Path
    first: int
    masks: str = ""
    solid: tuple[float, float] | None = None
    unused: int = 0


def find_pictures(
    root: Path,
    layout: Layout,
    numbers: Sequence[int],
    images: str = "",
    masks: str = "",
    first: int | None = None,
) -> VideoPictures:
    """Find the image and the mask of every frame.

    ``root``: The tracker's output. ``numbers``: Numbers of the frames. ``images``, ``masks``: Folders; "" takes those of
    the layout, in ``root`` and, for images, beside it. ``first``: Number of the image of frame 0; None takes that of the
    layout.
    """
    folder = _image_folder(root, layout, images)
    numbered = _numbered(folder)
    if first is None:
        known = layout.images.get(folder.name)
        first = min(numbered) if known is None else known
    wanted = {number: number + first for number in numbers}
    missing = [(number, image) for number, image in wanted.items() if image not in numbered]
    if missing:
        number, image = missing[0]
        expected = f"an image for each frame, such as {image:05d}.png for frame {number}"
        held = (
            f"images {min(numbered)} to {max(numbered)}, and none for {len(missing)} of {len(wanted)} frames"
        )
        remedy = f"Frame 0 was taken to be image {first}: another one is given by --first-image, another folder by --images."
        raise InputError(folder, "", expected, held, remedy)
    sources = _mask_folders(folder, layout, masks)
    pictures = {}
    for number, image in wanted.items():
        path = numbered[image]
        info = probe_image(path)
        mask, inside = (_of_image(one, path, image, info) for one in (sources.mask, sources.inside))
        if mask is None and inside is not None:
            mask, inside = inside, None
        pictures[number] = Picture(path, path if mask is None and info.has_alpha else mask, inside, info)
    plain = [picture.image for picture in pictures.values() if picture.mask is None]
    if 0 < len(plain) < len(pictures):
        raise InputError(plain[0], "", "an alpha channel, as other images have", "colours alone")
    return VideoPictures(
        frames=pictures,
        folder=folder,
        first=first,
        masks="" if plain else sources.described() or "alpha channels of the images",
        solid=((layout.subject[0] - 0.5) / 255, (layout.subject[1] + 0.5) / 255) if sources.labels else None,
        unused=len(numbered) - len(pictures),
    )


@dataclass(frozen=True)
class _Masks:
    """Files of masks by number."""

    mask: dict[int, Path] = field(default_factory=dict)
    inside: dict[int, Path] = field(default_factory=dict)
    labels: bool = False

    def described(self) -> str:
        folders = [next(iter(files.values())).parent.name for files in (self.mask, self.inside) if files]
        return " times ".join(folders)


def _image_folder(root: Path, layout: Layout, given: str) -> Path:
    places = [Path(given)] if given else [root, root.resolve().parent]
    folders = [place / name for place in places for name in layout.images]
    for folder in [*places, *folders] if given else folders:
        if _numbered(folder):
            return folder
    expected = f"a folder of the video's frames, named by numbers: {', '.join(layout.images)}"
    remedy = "" if given else "Give the folder of the frames that were tracked with --images."
    found = (
        "no such folder" if given and not Path(given).is_dir() else "no PNG or JPEG images named by numbers"
    )
    raise InputError(given or root, "", expected, found, remedy)


def _mask_folders(images: Path, layout: Layout, given: str) -> _Masks:
    if given:
        found = _numbered(Path(given))
        if not found:
            raise InputError(
                given, "", "a folder of masks, named by the numbers of the images", "no such masks"
            )
        return _Masks(found)
    inside = _numbered(images.parent / INSIDE, INSIDE_SUFFIX)
    for name in layout.masks:
        if found := _numbered(images.parent / name):
            return _Masks(found, inside)
    if layout.labels and (found := _numbered(images.parent / layout.labels)):
        return _Masks(found, labels=True)
    return _Masks(inside=inside)


def _of_image(masks: Mapping[int, Path], image: Path, number: int, info: ImageInfo) -> Path | None:
    """The mask of an image; None if there are no masks."""
    if not masks:
        return None
    if number not in masks:
        folder = next(iter(masks.values())).parent
        remedy = "Make the missing masks, or move the folder away to import without masks."
        raise InputError(
            folder, "", f"a mask for each image, such as {image.name}", "none of that number", remedy
        )
    path = masks[number]
    own = probe_image(path)
    if (own.width, own.height) != (info.width, info.height):
        raise InputError(
            path, "", f"{info.width}x{info.height} pixels, as its image", f"{own.width}x{own.height}"
        )
    return path


def _numbered(folder: Path, ending: str = "") -> dict[int, Path]:
    """Images of a folder by the number in their names, which end as given; a PNG before a JPEG of the same number."""
    parameters = {}
    for path in sorted(entries(folder), key=lambda path: path.suffix.lower()):
        stem = path.stem.removesuffix(ending)
        named = path.stem.endswith(ending) and stem.isascii() and stem.isdecimal() and len(stem) < 10
        if named and path.suffix.lower() in IMAGES:
            parameters[int(stem)] = path
    return parameters


FOLDER, SUFFIX = "checkpoint", ".frame"


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """One timestep as a tracker found it, in this project's units and axes; the same for all trackers. The head's root
    is at rest in the world of ``world_to_camera``: its motion is in the camera."""

    file: Path
    number: int
    """The tracker's file and the number in its name."""
    width: int
    height: int
    """Size of the image that was tracked, pixels."""
    K: FloatArray
    """(3, 3), pixels of that image; its upper left corner is (0, 0)."""
    world_to_camera: FloatArray
    """(4, 4) rigid motion, metres, OpenCV axes."""
    shape: FloatArray
    expression: FloatArray
    """Coefficients, as many as the tracker has."""
    neck: FloatArray
    jaw: FloatArray
    eyes: FloatArray
    """(3,), (3,), (6,) axis-angle; eyes left, then right."""
    eyelids: FloatArray
    """(2,) left, right."""


Convert = Callable[[Path, int, Mapping[str, np.ndarray]], TrackedFrame]
"""Makes a timestep of a file's checked arrays, whose names have dots: ``flame.exp``."""


def frame_files(root: Path) -> dict[int, Path]:
    """Files of the timesteps by number, in ``root`` or its folder ``checkpoint``; {} if there are none."""
    files: dict[int, Path] = {}
    for path in entries(root, f"*{SUFFIX}") or entries(root / FOLDER, f"*{SUFFIX}"):
        number = frame_number(path, "", path.stem)
        if number in files:
            raise InputError(
                path, "", "every frame once", f"frame {number} again, which is {files[number].name} too"
            )
        files[number] = path
    return dict(sorted(files.items()))


def read_members(path: Path) -> dict[str, np.ndarray]:
    """All arrays of a file, with dots in the names of those in dictionaries inside."""
    arrays: dict[str, np.ndarray] = {}
    for name, value in read_saved(path).items():
        inside: Mapping[str, Any] = value if isinstance(value, dict) else {}
        named = {name: value, **{f"{name}.{key}": part for key, part in inside.items()}}
        arrays |= {key: array for key, array in named.items() if isinstance(array, np.ndarray)}
    return arrays


def read_frames(
    files: Mapping[int, Path], members: Mapping[str, Member], convert: Convert
) -> list[TrackedFrame]:
    """Read the timesteps of one video."""
    frames: list[TrackedFrame] = []
    sizes: dict[str, int] = {}
    for number, path in files.items():
        arrays = read_members(path)
        sizes = check_arrays(path, arrays, members, sizes)
        frame = convert(path, number, arrays)
        frames.append(frame)
        first = frames[0]
        if (frame.width, frame.height) != (first.width, first.height):
            expected = f"{first.width}x{first.height}, as {first.file.name} has"
            raise InputError(
                path, "img_size", expected, f"{frame.width}x{frame.height}", "Track the video again."
            )
        change = float(np.abs(frame.shape - first.shape).max(initial=0.0))
        if not change <= SAME_IDENTITY:
            expected = f"the identity of {first.file.name}, as one video has"
            remedy = "Files of several runs may be mixed: track the video again into an empty folder."
            raise InputError(path, "flame.shape", expected, f"coefficients that differ by {change:g}", remedy)
    return frames


SAME_IDENTITY = 1e-5
"""Maximum difference of the identity coefficients of one video."""


def image_size(path: Path, arrays: Mapping[str, np.ndarray]) -> tuple[int, int]:
    """Width and height of the tracked image; files have height and width."""
    height, width = (int(value) for value in arrays["img_size"])
    if min(width, height) < 1:
        raise InputError(path, "img_size", "height and width in pixels", f"{height}, {width}")
    return width, height


CLOSED = 0.05
"""Eyelid coefficient above which an eye counts as partly closed; 1 closes it."""


def video_track(
    root: Path,
    frames: Sequence[TrackedFrame],
    pictures: VideoPictures,
    head: HeadArrays,
    *,
    resized: bool = False,
) -> Track:
    """Join frames, images and head model.

    ``frames``: Of one video, at least one. ``head``: Coefficients beyond its bases must be zero; missing ones are zero.
    ``resized``: Whether images may have another size than the ones tracked, with the same ratio of width to height.
    """
    identities, expressions = head.shape_basis.shape[2], head.expression_basis.shape[2]
    numbers = []
    for frame in frames:
        picture = pictures.frames[frame.number]
        pose = HeadPose(
            head_model=head.version,
            expression=coefficients(frame.file, "flame.exp", frame.expression, expressions),
            rotation=np.zeros(3),
            neck=frame.neck,
            jaw=frame.jaw,
            eyes=frame.eyes,
            translation=np.zeros(3),
            eyelids=None if head.eyelid_basis is None else frame.eyelids,
        )
        camera = _camera(frame, picture, resized=resized)
        numbers.append(
            VideoFrame(
                where=(frame.file, ""),
                sequence=VIDEO,
                number=frame.number,
                image=picture.image,
                mask=picture.mask,
                camera=camera,
                pose=pose,
                inside=picture.inside,
            )
        )
    first = frames[0]
    return Track(
        frames=ordered(root, numbers),
        shape=coefficients(first.file, "flame.shape", first.shape, identities),
        held_out=None,
        files=frozenset(frame.file for frame in frames),
        solid=pictures.solid,
    )


def _camera(frame: TrackedFrame, picture: Picture, *, resized: bool) -> Camera:
    camera = Camera("0", frame.width, frame.height, frame.K, frame.world_to_camera)
    width, height = picture.info.width, picture.info.height
    same = (width, height) == (frame.width, frame.height)
    if not same and not (resized and width * frame.height == height * frame.width):
        expected = f"{frame.width}x{frame.height} pixels, the size that {frame.file.name} was tracked at"
        remedy = "Give the images that the tracker read, cropped and resized, with --images."
        raise InputError(picture.image, "", expected, f"{width}x{height}", remedy)
    return camera.resized(width, height)


def left_out(frames: Sequence[TrackedFrame], head: HeadArrays) -> Mapping[str, Any]:
    """What the head model cannot represent, with its size, by name; {} for nothing."""
    lids = np.array([frame.eyelids for frame in frames])
    largest = float(np.abs(lids).max())
    if not largest:
        return {}
    if head.eyelid_basis is None:
        used = int((np.abs(lids).max(axis=1) > CLOSED).sum())
        return {
            "eyelids": f"up to {largest:.2f} (1 closes an eye), above {CLOSED} in {used} of {len(frames)} frames. "
            f"The head model has no eyelid basis. {EYELIDS_REMEDY}"
        }
    moved = np.abs(lids) @ np.linalg.norm(head.eyelid_basis, axis=1).max(axis=0)
    neck = 2 * np.sin(np.linalg.norm([frame.neck for frame in frames], axis=1) / 2)
    error = 1e3 * float((moved * neck).max())
    # Trackers turn lids with the root alone, this project with root and neck.
    return (
        {"eyelids_with_neck": f"lids turn with the neck here: up to {error:.2f} mm"} if error >= 0.005 else {}
    )
