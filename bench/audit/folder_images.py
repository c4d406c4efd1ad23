"""Finds and checks the images that somebody else rendered, named by key."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from ..contracts import Clip, FrameKey
from ..errors import InputError
from ..io.images import probe_image
from ..protocol import Protocol
from ..runner.store import Cell

SHOWN = 3


def find_images(
    folder: Path, clips: Sequence[Clip], protocols: Mapping[str, Protocol]
) -> dict[tuple[str, FrameKey], Path]:
    """Find the image of every frame of every protocol, by task and key, each checked but for its pixels.

    Raises
    ------
    InputError
        For a folder that is not there, images that are missing (how many, and where the first was looked for), and one
        that is not 8-bit RGB, not of the truth's size, or not fully opaque.
    """
    if not folder.is_dir():
        raise InputError(folder, "", "a folder of images", "no such folder")
    cameras = {clip.subject: clip.cameras for clip in clips}
    found: dict[tuple[str, FrameKey], Path] = {}
    missing: list[tuple[str, FrameKey]] = []
    for task, protocol in protocols.items():
        for key in protocol.keys:
            path = next((p for p in _places(folder, task, key, len(clips)) if p.is_file()), None)
            if path is None:
                missing.append((task, key))
            else:
                found[task, key] = path
    if missing:
        looked = ", ".join(str(p.relative_to(folder)) for p in _places(folder, *missing[0], len(clips)))
        expected = f"an image for each of {len(found) + len(missing)} frames"
        first = "; ".join(f"{task} {key}" for task, key in missing[:SHOWN])
        remedy = f"The first was looked for as {looked}."
        raise InputError(folder, "", expected, f"{len(missing)} without, such as {first}", remedy)
    for (_, key), path in found.items():
        camera = cameras[key.subject][key.camera]
        _check(path, (camera.width, camera.height))
    return found


def _places(folder: Path, task: str, key: FrameKey, subjects: int) -> list[Path]:
    """Where the image of a frame may lie, by falling precedence."""
    name = Cell(folder).render(task, key).name
    roots = [folder / key.subject] + ([folder] if subjects == 1 else [])
    return [place / name for root in roots for place in (root / "renders" / task, root / task, root)]


def _check(path: Path, size: tuple[int, int]) -> None:
    info = probe_image(path)  # before Pillow decodes what may be a bomb
    if (info.width, info.height) != size:
        expected, found = ("{} x {} pixels".format(*pair) for pair in (size, (info.width, info.height)))
        raise InputError(path, "size", f"{expected}, as the ground truth", found)
    try:
        with Image.open(path) as image:
            if image.format != "PNG":
                raise InputError(path, "format", "PNG, which is lossless", str(image.format))
            if image.mode == "RGBA" and image.getchannel("A").getextrema() != (255, 255):
                remedy = "Composite it on the background of the capture."
                raise InputError(path, "alpha", "an opaque image", "transparent pixels", remedy)
            if image.mode not in ("RGB", "RGBA"):
                raise InputError(path, "mode", "8-bit RGB", str(image.mode))
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as error:
        raise InputError(path, "", "a PNG image", f"a file that cannot be read ({error})") from error
