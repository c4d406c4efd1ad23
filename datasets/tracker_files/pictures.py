"""Images and masks of tracked frames, found by the numbers in their names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from ...bench.errors import InputError
from ...bench.io.files import entries
from ...bench.io.images import ImageInfo, probe_image

IMAGES = (".jpeg", ".jpg", ".png")
INSIDE, INSIDE_SUFFIX = "parsing", "_neckhead"
"""Folder and ending of the names of FlashAvatar's masks of head and neck."""


@dataclass(frozen=True)
class Layout:
    """Locations of a tracker's images and masks.

    Attributes
    ----------
    images : Mapping[str, int | None]
        Folders of images, the first of which that exists is taken, and the number of the image of frame 0; None takes the
        lowest number in the folder.
    masks : tuple[str, ...]
        Folders of masks beside that of the images.
    labels : str
        Folder of label images beside that of the images; "" for none.
    subject : tuple[int, int]
        First and last label of the subject.
    resized : bool
        Whether images may be larger than the ones tracked, with the same ratio of width to height.
    """

    images: Mapping[str, int | None]
    masks: tuple[str, ...] = ()
    labels: str = ""
    subject: tuple[int, int] = (1, 255)
    resized: bool = False


class Picture(NamedTuple):
    """Files of a frame, and the size of the image."""

    image: Path
    mask: Path | None
    inside: Path | None
    info: ImageInfo


@dataclass(frozen=True)
class VideoPictures:
    """Files by frame number.

    ``masks`` describes the masks, "" if there are none; ``solid`` is `Track.solid`. ``unused`` is the number of images without
    a tracked frame.
    """

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

    Parameters
    ----------
    root : Path
        The tracker's output.
    numbers : Sequence[int]
        Numbers of the frames.
    images, masks : str
        Folders; "" takes those of the layout, in ``root`` and, for images, beside it.
    first : int | None
        Number of the image of frame 0; None takes that of the layout.
    """
    folder = _image_folder(root, layout, images)
    found = _numbered(folder)
    if first is None:
        known = layout.images.get(folder.name)
        first = min(found) if known is None else known
    wanted = {number: number + first for number in numbers}
    missing = [(number, image) for number, image in wanted.items() if image not in found]
    if missing:
        number, image = missing[0]
        expected = f"an image for each frame, such as {image:05d}.png for frame {number}"
        held = f"images {min(found)} to {max(found)}, and none for {len(missing)} of {len(wanted)} frames"
        remedy = f"Frame 0 was taken to be image {first}: another one is given by --first-image, another folder by --images."
        raise InputError(folder, "", expected, held, remedy)
    sources = _mask_folders(folder, layout, masks)
    pictures = {}
    for number, image in wanted.items():
        path = found[image]
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
        unused=len(found) - len(pictures),
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
    found = {}
    for path in sorted(entries(folder), key=lambda path: path.suffix.lower()):
        stem = path.stem.removesuffix(ending)
        named = path.stem.endswith(ending) and stem.isascii() and stem.isdecimal() and len(stem) < 10
        if named and path.suffix.lower() in IMAGES:
            found[int(stem)] = path
    return found
