"""Stream the frames of many cameras in parallel, each on one thread, one frame at a time, and write their images.

Threads are sufficient because OpenCV releases the interpreter's lock for decoding, shrinking and encoding.
"""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2

from ...bench.contracts import ByteArray, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.images import read_bgr
from ...bench.machine import processor_count
from ..images import is_whole, read_mask, write_image
from .pixels import prepare_pixels, read_still
from .plan import SequenceJob
from .sequence import RecordedView, open_video


class RawFrame(NamedTuple):
    """A frame as OpenCV decodes it."""

    number: int
    bgr: ByteArray
    """(H, W, 3), channels in OpenCV's order, since reordering after shrinking is cheaper."""
    mask: ByteArray | None
    """(H, W) foreground coverage."""


def read_frames(view: RecordedView, numbers: Sequence[int]) -> Iterator[RawFrame]:
    """Decode the frames with these ascending numbers, one at a time.

    Raises `InputError` if a frame does not decode, or a video ends before the number of frames in its index.
    """
    if view.video is None:
        for number in numbers:
            mask = read_mask(view.masks[number], view.size) if view.masks else None
            bgr = read_bgr(view.images[number], view.size)
            yield RawFrame(number, bgr, mask)
        return
    frames = _decode_video(view.video, view, numbers)
    if view.mask_video is None:
        yield from (RawFrame(number, bgr, None) for number, bgr in zip(numbers, frames))
        return
    masks = _decode_video(view.mask_video, view, numbers)
    for number, bgr, mask in zip(numbers, frames, masks):
        # Masks are grey; videos store three equal channels.
        yield RawFrame(number, bgr, cv2.extractChannel(mask, 0).astype("uint8", copy=False))


def _decode_video(path: Path, view: RecordedView, numbers: Sequence[int]) -> Iterator[ByteArray]:
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


@dataclass(frozen=True, eq=False)
class _Stream:
    """Missing files of one camera of one sequence."""

    job: SequenceJob
    index: int
    timesteps: tuple[int, ...]


def write_images(
    jobs: Sequence[SequenceJob], *, workers: int = 0, progress: Progress = no_progress
) -> tuple[int, int]:
    """Write missing images; return the numbers of written and existing images.

    Complete existing images are kept. The first error stops all streams and is raised; what was written
    stays, and another call continues with it.
    """
    streams = [_missing(job, index) for job in jobs for index in range(len(job.cameras))]
    total = sum(job.count * len(job.cameras) for job in jobs)
    kept = total - sum(len(stream.timesteps) for stream in streams)
    streams = [stream for stream in streams if stream.timesteps]
    reports: queue.SimpleQueue[Future[None] | str] = queue.SimpleQueue()
    stop = threading.Event()
    done = kept
    with ThreadPoolExecutor(workers or processor_count()) as pool:
        for stream in streams:
            pool.submit(_run, stream, reports, stop).add_done_callback(reports.put)
        try:
            running = len(streams)
            while running:
                report = reports.get()
                if isinstance(report, Future):
                    report.result()  # re-raises the stream's exception
                    running -= 1
                else:
                    done += 1
                    progress(done, total, report)
        finally:
            stop.set()
            pool.shutdown(wait=True, cancel_futures=True)
    return done - kept, kept


def _run(stream: _Stream, reports: queue.SimpleQueue, stop: threading.Event) -> None:
    """Process a stream and report each image, until the end or until stopped."""
    job, index = stream.job, stream.index
    camera = job.cameras[index]
    correct = job.corrections.get(camera.id)
    size = camera.width, camera.height
    numbers = [job.recorded.numbers[timestep] for timestep in stream.timesteps]
    view = job.recorded.views[camera.id]
    still = read_still(job.stills[camera.id], view.size) if camera.id in job.stills else None
    frames = read_frames(view, numbers)
    for timestep, frame in zip(stream.timesteps, frames):
        if stop.is_set():
            return
        image, mask = prepare_pixels(frame.bgr, frame.mask, size, correct, still)
        with writing(job.image_path(timestep, index)):
            if mask is not None:
                write_image(job.mask_path(timestep, index), mask)
            write_image(
                job.image_path(timestep, index), image
            )  # written last: its image marks a complete frame
        reports.put(f"{job.recorded.subject} {job.recorded.name}")


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Convert a system error to an `InputError` with file, reason and remedy."""
    try:
        yield
    except OSError as error:
        remedy = "Free disk space or allow writing, then start again: the command continues where it stopped."
        found = error.strerror or str(error)
        raise InputError(error.filename or path, "", "a file that can be written", found, remedy) from error


def _missing(job: SequenceJob, index: int) -> _Stream:
    camera = job.cameras[index]
    present = file_names(job.folder / "images")
    masks = file_names(job.folder / "fg_masks") if job.recorded.has_masks else None
    timesteps = []
    for timestep in range(job.count):
        image, mask = job.image_path(timestep, index), job.mask_path(timestep, index)
        whole = image.name in present and is_whole(image, camera.width, camera.height)
        if masks is not None:
            whole = whole and mask.name in masks and is_whole(mask, camera.width, camera.height)
        if not whole:
            timesteps.append(timestep)
    return _Stream(job, index, tuple(timesteps))


def file_names(folder: Path) -> set[str]:
    """Names in a folder; none if it does not exist."""
    return set(os.listdir(folder)) if folder.is_dir() else set()
