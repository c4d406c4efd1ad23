"""Prepare a subject: images, cameras, parameters and splits in the GaussianAvatars/VHAP layout.

Each sequence folder holds a record (`RECORD_FILE`) of what its images and its metadata were made from. A call
continues an earlier one, does nothing if everything exists, refuses to mix images of other settings, and rewrites
parameters and JSONs when the tracking has changed. JSONs are deleted first and written last, so that no incomplete
folder is read as a capture.
"""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.documents import checked, read_json
from ...bench.io.files import digest, write_json
from ...bench.io.images import read_bgr
from ...bench.io.lock import locked, remove_temporaries
from ...bench.machine import processor_count
from ..ga import layout
from ..ga.writer import camera_record, file_record, save_npz, transforms_document, write_sequence, write_union
from ..head.arrays import save_head
from ..images import is_whole, read_mask, write_image
from .plan import CY, PreparationPlan, SequenceJob
from .recording import prepare_pixels, read_still
from .sequence import RecordedView, open_video
from .tracking import TrackedSequence


class RawFrame(NamedTuple):
    """A frame as OpenCV decodes it."""

    number: int
    bgr: ByteArray
    """(H, W, 3), channels in OpenCV's order, since reordering after shrinking is cheaper."""
    mask: ByteArray | None
    """(H, W) foreground coverage."""


def read_frames(view: RecordedView, numbers: Sequence[int]) -> Iterator[RawFrame]:
    """Decode the frames with these ascending numbers, one at a time."""
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
    """Write missing images; return the numbers of written and existing images. Complete existing images are kept. The
    first error stops all streams and is raised; what was written stays, and another call continues with it."""
    streams = [_missing_frames(job, index) for job in jobs for index in range(len(job.cameras))]
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
    if job.on_white:
        still = np.full((*view.size[::-1], 3), 255, np.uint8)
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


def _missing_frames(job: SequenceJob, index: int) -> _Stream:
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


RECORD_FILE = "headbench-prepare.json"
RECORD_VERSION = 1

BACKUP_FILE = "transforms_backup.json"
"""Frames and cameras before tracking: no parameters, no shift."""

_READABLE = (*layout.SPLIT_FILES.values(), layout.ALL_FRAMES_FILE)
"""Files that identify a folder as a capture."""


@dataclass(frozen=True)
class SequenceState:
    """Content of a sequence folder's record. Empty fingerprints stand for incomplete files."""

    images: str = ""
    images_complete: bool = False
    metadata: str = ""


@dataclass(frozen=True)
class SubjectResult:
    """Result for a subject."""

    subject: str
    written: int
    kept: int
    """Number of images."""
    frames: dict[str, int]
    """Frames per split of the union; empty where there is none."""
    union: Path | None
    """The folder to give to a reader, or None."""
    missing: tuple[str, ...]
    """Reasons why the capture is not complete, one sentence each."""


def prepare(
    plans: Sequence[PreparationPlan], *, workers: int = 0, progress: Progress = no_progress
) -> list[SubjectResult]:
    """Prepare subjects."""
    with ExitStack() as stack:
        for plan in plans:  # one by one: other subjects of the same folder may be prepared elsewhere
            stack.enter_context(locked(plan.union, beside=True))
            for job in plan.jobs:
                remove_temporaries(job.folder)
        return _prepare(plans, workers, progress)


def _prepare(plans: Sequence[PreparationPlan], workers: int, progress: Progress) -> list[SubjectResult]:
    states = {job.folder: _checked_state(job) for plan in plans for job in plan.jobs}
    jobs = [job for plan in plans for job in plan.jobs]
    open_jobs = [job for job in jobs if not _has_all_images(job, states[job.folder])]
    for job in open_jobs:
        started = replace(states[job.folder], images=job.images_fingerprint, images_complete=False)
        with writing(job.folder / RECORD_FILE):
            _write_state(job, started)
            states[job.folder] = started
    before = {job.folder: count_images(job) for job in open_jobs}
    write_images(open_jobs, workers=workers, progress=progress)
    results = []
    for plan in plans:
        for job in plan.jobs:
            with writing(job.folder):
                _write_metadata(plan, job, states[job.folder])
        with writing(plan.union):
            frames = _write_union(plan)
        total = sum(job.count * len(job.cameras) for job in plan.jobs)
        kept = sum(before.get(job.folder, job.count * len(job.cameras)) for job in plan.jobs)
        results.append(
            SubjectResult(
                plan.subject, total - kept, kept, frames, plan.union if frames else None, _missing(plan)
            )
        )
    return results


def _checked_state(job: SequenceJob) -> SequenceState:
    """The record of a job's folder."""
    path = job.folder / RECORD_FILE
    if not path.exists():
        if (job.folder / "images").is_dir() and any((job.folder / "images").iterdir()):
            found = "images of unknown origin"
            raise InputError(
                job.folder, "images", "a folder written by this command, or an empty one", found, _ELSEWHERE
            )
        return SequenceState()
    value = read_json(path)
    texts = all(isinstance(value.get(key), str) for key in ("images", "metadata"))
    if value.get("format_version") != RECORD_VERSION or not texts:
        found = f"format_version {value.get('format_version')!r}"
        raise InputError(path, "", f"a record of format_version {RECORD_VERSION}", found, _ELSEWHERE)
    if value["images"] != job.images_fingerprint:
        expected = "images made from these files with these settings"
        raise InputError(path, "images", expected, "images made from others", _ELSEWHERE)
    return SequenceState(value["images"], value.get("images_complete") is True, value["metadata"])


_ELSEWHERE = "Give another --out, or delete the folder."


def _write_state(job: SequenceJob, state: SequenceState) -> None:
    recorded = job.recorded
    videos = any(view.video for view in recorded.views.values())
    kinds = sorted({type(correction).__name__ for correction in job.corrections.values()})
    value: dict[str, Any] = {
        "format_version": RECORD_VERSION,
        "images": state.images,
        "images_complete": state.images_complete,
        "metadata": state.metadata,
        "subject": recorded.subject,
        "sequence": recorded.name,
        "source": "video" if videos else "images",
        "frames": list(recorded.numbers),
        "mattes": recorded.has_masks,
        "colour": kinds[0] if kinds else "none",
        "edges": "unblend" if job.stills else "plain",
    }
    write_json(job.folder / RECORD_FILE, value)


def _has_all_images(job: SequenceJob, state: SequenceState) -> bool:
    if not state.images_complete:
        return False
    expected = job.count * len(job.cameras)
    masks = len(file_names(job.folder / "fg_masks")) if job.recorded.has_masks else expected
    return count_images(job) == expected == masks


def count_images(job: SequenceJob) -> int:
    """Number of images of a job that are there."""
    wanted = {
        job.image_path(timestep, index).name
        for timestep in range(job.count)
        for index in range(len(job.cameras))
    }
    return len(wanted & file_names(job.folder / "images"))


def _write_metadata(plan: PreparationPlan, job: SequenceJob, state: SequenceState) -> None:
    """Write a sequence's JSONs and parameters, unless they are there already. A call without tracking leaves the
    parameters that an earlier call wrote."""
    if job.tracked is None and (_is_readable(job) or (state.images_complete and state.metadata)):
        if not state.images_complete:
            _write_state(job, replace(state, images_complete=True))
        return
    declaration = plan.declaration([job], f"../{plan.union.name}/{layout.HEAD_FILE}")
    fingerprint = job.metadata_fingerprint(declaration)
    if state.images_complete and state.metadata == fingerprint and _is_readable(job):
        return
    for folder in (job.folder, plan.union):
        for name in _READABLE:
            (folder / name).unlink(missing_ok=True)
    _write_state(job, replace(state, images_complete=True, metadata=""))
    bare = [{k: v for k, v in f.items() if k != "flame_param_path"} for f in _frames(job, np.zeros(3))]
    write_json(job.folder / BACKUP_FILE, transforms_document(bare, _intrinsics(job.cameras[-1])))
    if job.tracked is not None:
        _write_tracked(plan, job, job.tracked, declaration)
    _write_state(job, replace(state, images_complete=True, metadata=fingerprint))


def _intrinsics(camera: Camera) -> dict[str, float | int]:
    return layout.intrinsics_to_json(camera, CY)


def _frames(job: SequenceJob, shift: FloatArray) -> list[dict[str, Any]]:
    """Frame records in the world whose origin is at ``shift``: timestep outer, camera inner, VHAP's order of keys."""
    records = [camera_record(_moved(camera, shift), index, CY) for index, camera in enumerate(job.cameras)]
    return [
        {
            "timestep_index": timestep,
            "timestep_index_original": timestep,
            "timestep_id": f"{number:06d}",
            **record,
            **file_record(timestep, index, mask=job.recorded.has_masks),
        }
        for timestep, number in enumerate(job.recorded.numbers)
        for index, record in enumerate(records)
    ]


def _moved(camera: Camera, shift: FloatArray) -> Camera:
    matrix = camera.world_to_camera.copy()
    matrix[:3, 3] += matrix[:3, :3] @ shift
    return replace(camera, world_to_camera=matrix)


def _write_tracked(
    plan: PreparationPlan, job: SequenceJob, tracked: TrackedSequence, declaration: layout.Declaration
) -> None:
    """Write parameters and JSONs in the world whose mean translation is zero."""
    for timestep in range(tracked.count):
        path = job.folder / layout.TRACKING_FOLDER / layout.parameter_name(timestep)
        save_npz(path, tracked.parameters(timestep))
    save_npz(job.folder / layout.CANONICAL_FILE, tracked.canonical())
    frames = _frames(job, tracked.shift)
    write_sequence(job.folder, frames, _intrinsics(job.cameras[-1]), plan.novel_views, declaration)


def _is_readable(job: SequenceJob) -> bool:
    """Whether the folder is a capture with images, parameters and JSONs."""
    return all((job.folder / name).exists() for name in _READABLE)


def _write_union(plan: PreparationPlan) -> dict[str, int]:
    """Write the union if every sequence is tracked and it does not exist; returns the number of frames per split."""
    if not all(_is_readable(job) for job in plan.jobs):
        return {}
    train = [job for job in plan.jobs if job.recorded.name not in plan.test]
    test = [job for job in plan.jobs if job.recorded.name in plan.test]
    own_head = plan.head is not None and not plan.head.version.startswith("flame")
    declaration = plan.declaration([*train, *test], layout.HEAD_FILE)
    head = plan.head.fingerprint() if plan.head is not None and own_head else ""
    members = [read_json(job.folder / RECORD_FILE)["metadata"] for job in (*train, *test)]
    fingerprint = digest(declaration, members, plan.test, head)
    record = plan.union / RECORD_FILE
    readable = all((plan.union / name).exists() for name in layout.SPLIT_FILES.values())
    if readable and record.exists():
        value = read_json(record)
        if value.get("metadata") == fingerprint and "frames" in value:
            return checked(value["frames"], dict[str, int], record, "frames")
    if own_head and plan.head is not None:  # FLAME's licence forbids copies; readers are given its file
        save_head(plan.union / layout.HEAD_FILE, plan.head)
    folders = [job.folder for job in train], [job.folder for job in test]
    frames = write_union(plan.union, *folders, plan.novel_views, declaration)
    write_json(record, {"format_version": RECORD_VERSION, "metadata": fingerprint, "frames": frames})
    return frames


def _missing(plan: PreparationPlan) -> tuple[str, ...]:
    """Missing parts of the capture, one sentence each."""
    untracked = [job.recorded.name for job in plan.jobs if not _is_readable(job)]
    unmasked = [job.recorded.name for job in plan.jobs if not job.recorded.has_masks]
    plain = [job.recorded.name for job in plan.jobs if not job.corrections and not job.on_white]
    cameras = {camera.id for job in plan.jobs for camera in job.cameras}
    lines = []
    if untracked:
        lines.append(
            f"no tracked parameters for {', '.join(untracked)}: no {layout.ALL_FRAMES_FILE} and no union. Run "
            "VHAP and call again with --tracking."
        )
    if unmasked:
        lines.append(
            f"no masks for {', '.join(unmasked)}: images keep their background, and there are no masks. Make "
            "alpha_maps (VHAP's preprocessing) and prepare into another folder; a difference to the BACKGROUND "
            "stills is not good enough, as heads cast shadows and share the background's greys."
        )
    if plain:
        lines.append(f"no colour correction for {', '.join(plain)}: colours are as recorded.")
    if not plan.test:
        lines.append("no held-out sequence among those prepared: nothing to test self-reenactment on.")
    for camera in set(plan.novel_views) - cameras:
        lines.append(f"no camera {camera}: nothing to test novel views on.")
    return tuple(lines)
