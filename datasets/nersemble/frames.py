"""Stream the frames of one camera, one at a time, however long the sequence is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2

from ...bench.contracts import ByteArray
from ...bench.errors import InputError
from ...bench.io.images import read_pixels
from .sequence import View, open_video


class RawFrame(NamedTuple):
    """A frame as OpenCV decodes it."""

    number: int
    bgr: ByteArray
    """(H, W, 3), channels in OpenCV's order: what follows shrinks the image first and reorders less."""
    matte: ByteArray | None
    """(H, W) foreground coverage."""


def read_frames(view: View, numbers: Sequence[int]) -> Iterator[RawFrame]:
    """Decode the frames with these ascending numbers; memory holds one at a time.

    Raises `InputError` where a frame does not decode, or a video ends before the count its index declares.
    """
    if view.video is None:
        for number in numbers:
            matte = read_pixels(view.mattes[number], cv2.IMREAD_GRAYSCALE, view.size) if view.mattes else None
            bgr = read_pixels(view.images[number], cv2.IMREAD_COLOR, view.size)
            yield RawFrame(number, bgr, matte)
        return
    frames = _decode_video(view.video, view, numbers)
    if view.matte_video is None:
        yield from (RawFrame(number, bgr, None) for number, bgr in zip(numbers, frames))
        return
    mattes = _decode_video(view.matte_video, view, numbers)
    for number, bgr, matte in zip(numbers, frames, mattes):
        yield RawFrame(number, bgr, _one_channel(matte))


def _one_channel(matte: ByteArray) -> ByteArray:
    """First channel: mattes are grey, and videos have it thrice."""
    return cv2.extractChannel(matte, 0).astype("uint8", copy=False)


def _decode_video(path: Path, view: View, numbers: Sequence[int]) -> Iterator[ByteArray]:
    """Frames of a video. Those in between are decoded too, as seeking is not exact, but not converted."""
    capture = open_video(path)
    try:
        position = 0
        for number in numbers:
            while position <= number:
                if not capture.grab():
                    raise _ended(path, position, view.count)
                position += 1
            good, bgr = capture.retrieve()
            if not good or (bgr.shape[1], bgr.shape[0]) != view.size:
                raise _ended(path, number, view.count)
            yield bgr.astype("uint8", copy=False)
    finally:
        capture.release()


def _ended(path: Path, number: int, count: int) -> InputError:
    expected = f"a frame that decodes, as the index declares {count} frames"
    return InputError(path, f"frame {number}", expected, "the end of the stream", "Fetch the file again.")
