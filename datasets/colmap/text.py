"""Read cameras.txt and images.txt."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

from ...bench.errors import InputError
from .records import ColmapCamera, ColmapImage, camera_models, checked_camera, checked_image

_LONGEST_LINE = 2**23  # 300,000 points of an image; words take ten times the memory of their line
_IMAGE_WORDS = 10  # number, quaternion, translation, camera, name


def read_cameras_text(file: Path) -> dict[int, ColmapCamera]:
    """Cameras by number; `InputError` for whatever is wrong with the file."""
    lengths = dict(camera_models().values())
    cameras: dict[int, ColmapCamera] = {}
    for line, words in _lines(file):
        if not words:
            continue
        key = f"line {line}"
        if len(words) < 4 or words[1] not in lengths:
            raise InputError(
                file, key, "a number, a camera model pycolmap knows and a size", " ".join(words)[:80]
            )
        if len(words) != 4 + lengths[words[1]]:
            expected = f"{lengths[words[1]]} parameters of {words[1]}"
            raise InputError(file, key, expected, f"{len(words) - 4}")
        number, width, height = _whole(file, key, [words[0], words[2], words[3]])
        if number in cameras:
            raise InputError(file, key, "each camera once", f"camera {number} again")
        camera = ColmapCamera(words[1], width, height, _real(file, key, words[4:]))
        cameras[number] = checked_camera(file, number, camera)
    return cameras


def read_images_text(file: Path) -> dict[int, ColmapImage]:
    """Images by number; `InputError` for whatever is wrong with the file."""
    images: dict[int, ColmapImage] = {}
    lines = _lines(file)
    for line, words in lines:
        if not words:
            continue
        key = f"line {line}"
        if len(words) != _IMAGE_WORDS:
            raise InputError(file, key, f"{_IMAGE_WORDS} words of an image", f"{len(words)}")
        number, camera = _whole(file, key, [words[0], words[8]])
        if number in images:
            raise InputError(file, key, "each image once", f"image {number} again")
        pose = _real(file, key, words[1:8])
        image = ColmapImage(words[9], camera, pose[:4], pose[4:])
        images[number] = checked_image(file, number, image)
        _, points = next(lines, (0, ["missing"]))
        if len(points) % 3:
            raise InputError(
                file, f"line {line + 1}", "the image's points, three numbers each", "another line"
            )
    return images


def _lines(file: Path) -> Iterator[tuple[int, list[str]]]:
    """Number and words of each line that is no comment. An empty line may be an image without points."""
    try:
        with file.open(encoding="utf-8") as stream:
            for number, line in enumerate(iter(partial(stream.readline, _LONGEST_LINE + 1), ""), start=1):
                if len(line) > _LONGEST_LINE:
                    expected = f"at most {_LONGEST_LINE} characters in a line"
                    raise InputError(file, f"line {number}", expected, "more")
                if not line.startswith("#"):
                    yield number, line.split()
    except UnicodeDecodeError as error:
        raise InputError(file, "", "text in UTF-8", str(error)) from error


def _whole(file: Path, key: str, words: list[str]) -> list[int]:
    if not all(word.isascii() and word.isdigit() and len(word) < 20 for word in words):
        raise InputError(file, key, "whole numbers", ", ".join(words)[:80])
    return [int(word) for word in words]


def _real(file: Path, key: str, words: list[str]) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in words)
    except ValueError as error:
        raise InputError(file, key, "numbers", " ".join(words)[:80]) from error
