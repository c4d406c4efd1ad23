"""Converts the training data of the NeRSemble benchmark to captures.

The monocular track has the tracking of FLAME 2023, of which `render.read_sequence` makes poses and cameras. A capture has
the very world in which `headbench submission render` poses and views an avatar, since colours may depend on the direction.
The track of novel views has no tracking, so that its captures are for `headbench track`.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ....bench.contracts import Camera, FloatArray
from ....bench.engine.stored import SAME_SHAPE
from ....bench.errors import InputError
from ....bench.progress import some
from ...ga.tracking import POSE_SIZES, pose_to_parameters, resolve_teeth
from ...head.arrays import HeadArrays
from ..names import SEQUENCES, match_sequence
from ..plan import PreparationPlan, SequenceJob
from ..prepare import read_frames
from ..recording import Calibration, Participant, read_calibration
from ..sequence import RecordedSequence, read_sequence
from ..tracking import TrackedSequence
from .render import read_sequence as read_tracked_sequence
from .submission import MONO, BenchmarkTrack, tracking_file

log = logging.getLogger(__name__)

WHITE_LEVEL = 247
"""Least level of a white background after a video codec."""


def plan_participant(
    data: Path,
    track: BenchmarkTrack,
    one: Participant,
    head: HeadArrays,
    out: Path,
    test: Sequence[str] = (),
    every: int = 1,
) -> PreparationPlan:
    """Read everything about a participant except the pixels, of which one frame of each sequence is looked at."""
    names = [
        name for name in SEQUENCES if name in one.sequences and (one.sequences[name] / "images").is_dir()
    ]
    if not names:
        expected = "sequences with images/cam_SERIAL.mp4"
        remedy = f"Download them: nersemble-benchmark-download FOLDER {track.name}."
        raise InputError(data / track.name / one.subject, "sequences", expected, "none", remedy)
    planned = {*names, *track.sequences.get(one.subject, {})}
    if lacking := [name for name in SEQUENCES if name in one.sequences and name not in planned]:
        log.warning("%s: no videos of %s, which are left out", one.subject, some(lacking))
    held_out = [match_sequence("--test", name, names) for name in test]
    if not set(names) - set(held_out):
        raise InputError("command line", "--test", "at least one sequence to train on", ", ".join(held_out))
    calibration = read_calibration(one.calibration_file)
    jobs: list[SequenceJob] = []
    shape: FloatArray | None = None  # of the person, that of the first sequence
    others: dict[str, float] = {}  # greatest difference to it, by sequence
    for name in names:
        videos = {path.stem.removeprefix("cam_") for path in (one.sequences[name] / "images").glob("*.mp4")}
        serials = [serial for serial in calibration.serials if serial in videos]
        recorded = read_sequence(one, calibration, name, cameras=serials, source="video", every=every)
        for view in recorded.views.values():
            if view.size != track.size:
                expected, found = (f"{width}x{height}" for width, height in (track.size, view.size))
                raise InputError(recorded.folder, f"camera {view.serial}", f"{expected} pixels", found)
            if not view.has_masks:
                place = recorded.folder / "alpha_maps" / f"cam_{view.serial}.mp4"
                raise InputError(place, "", "the alpha maps of the frames", "no such file")
        _check_white(recorded)
        if track is MONO:
            cameras, tracked, own = _tracked(data, recorded, head, shape)
            shape = own if shape is None else shape
            if (difference := float(np.abs(own - shape).max())) > SAME_SHAPE:
                others[name] = difference
        else:
            cameras, tracked = _untracked(calibration, recorded, head)
        folder = Path(os.path.abspath(out)) / f"{one.subject}_{name}_v{len(serials)}_whiteBg"
        jobs.append(SequenceJob(recorded, cameras, {}, {}, tracked, folder, on_white=True))
    if others:
        log.warning(
            "%s: the tracking of %s has another shape of the head than that of %s, by up to %.3g; all get that of %s",
            *(one.subject, some([*others]), names[0], max(others.values()), names[0]),
        )
    union = jobs[0].folder.parent / f"UNION{len(jobs)}_{one.subject}_{track.name}"
    return PreparationPlan(one.subject, jobs, held_out, head, head.version, union, novel_views=())


def _check_white(recorded: RecordedSequence) -> None:
    """Warn if the first frame is not white outside of its alpha map: its colour would be left on soft edges."""
    view = next(iter(recorded.views.values()))
    frame = next(read_frames(view, recorded.numbers[:1]))
    outside = frame.bgr[frame.mask == 0]
    if len(outside) and (colour := np.median(outside, axis=0)).min() < WHITE_LEVEL:
        found = "{2:.0f}, {1:.0f}, {0:.0f}".format(*colour)
        why = (
            "%s, frame %d: expected white outside of the alpha map, found RGB %s, which soft edges will keep"
        )
        log.warning(why, view.video, frame.number, found)


def _tracked(
    data: Path, recorded: RecordedSequence, head: HeadArrays, shape: FloatArray | None
) -> tuple[list[Camera], TrackedSequence, FloatArray]:
    """Cameras and parameters of the frames that are kept, and the shape in the file, which ``shape`` replaces."""
    file = tracking_file(data, recorded.subject, recorded.name)
    sequence = read_tracked_sequence(data, MONO, recorded.subject, recorded.name, head, shape)
    count = max(view.count for view in recorded.views.values())
    if len(sequence.poses) != count:
        raise InputError(
            file, "expression", f"{count} rows, as the video has frames", f"{len(sequence.poses)}"
        )
    rows = [pose_to_parameters(sequence.poses[number]) for number in recorded.numbers]
    frames = {key: np.concatenate([row[key] for row in rows]) for key in rows[0]}
    cameras = [sequence.cameras[serial] for serial in recorded.views]
    constant = _constant(file, sequence.shape if shape is None else shape, head)
    return cameras, TrackedSequence(file, frames, constant), sequence.shape


def _untracked(
    calibration: Calibration, recorded: RecordedSequence, head: HeadArrays
) -> tuple[list[Camera], TrackedSequence]:
    """Cameras, and the mean head where their axes meet."""
    cameras = [calibration.camera(serial, view.size, view.size) for serial, view in recorded.views.items()]
    to_world = [np.linalg.inv(camera.world_to_camera) for camera in cameras]
    across = [np.eye(3) - np.outer(matrix[:3, 2], matrix[:3, 2]) for matrix in to_world]
    points = [projector @ matrix[:3, 3] for projector, matrix in zip(across, to_world)]
    centre = np.linalg.lstsq(np.sum(across, axis=0), np.sum(points, axis=0), rcond=None)[0]
    count = len(recorded.numbers)
    frames: dict[str, FloatArray] = {
        key: np.zeros((count, size), np.float32) for key, size in POSE_SIZES.items()
    }
    frames["expr"] = np.zeros((count, head.expression_basis.shape[2]), np.float32)
    frames["translation"] += centre.astype(np.float32)
    shape = np.zeros(head.shape_basis.shape[2])
    file = calibration.file
    return cameras, TrackedSequence(file, frames, _constant(file, shape, head))


def _constant(file: Path, shape: FloatArray, head: HeadArrays) -> dict[str, FloatArray]:
    rows = len(resolve_teeth(head, None, "auto", file)[0].template)
    return {"shape": shape.astype(np.float32), "static_offset": np.zeros((1, rows, 3), np.float32)}
