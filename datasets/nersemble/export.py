"""Metadata of a prepared sequence in the GaussianAvatars/VHAP layout, the union of several, and unions of others.

GaussianAvatars' download holds, per subject, a ``UNION10`` folder and its sequence folders, FREE among them;
the union's own test sequence is another one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...bench.contracts import Camera, FloatArray, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.documents import read_json
from ...bench.io.files import atomic_path, grouped_writes, write_json, write_text
from ...bench.specs import Findings
from ..ga import layout
from ..ga.transforms import FrameEntry, read_transforms, timesteps_of
from ..ga.validate import check_images, check_timesteps
from ..ga.writer import TRAIN_FRACTION, camera_record, file_record, save_npz, split_of, transforms_document
from .names import (
    FRONTAL_INDEX,
    NOVEL_VIEW_CAMERA,
    TEST_SEQUENCE,
    UNION10_SEQUENCES,
    match_sequence,
    union10_held_out,
)
from .tracking import TrackedSequence

BACKUP_FILE = "transforms_backup.json"
"""Frames and cameras before tracking: no parameters, no shift."""

CY: layout.CyConvention = "bottom"
"""Where VHAP's exports measure the principal point from."""


@dataclass(frozen=True, eq=False)
class SequenceExport:
    """A prepared sequence.

    Attributes
    ----------
    folder : of the sequence; its images are there.
    cameras : in index order, in the aligned world.
    numbers : frame number in the source by timestep.
    masks : whether every image has a mask.
    held_out : ids of the cameras for novel views.
    """

    folder: Path
    cameras: Sequence[Camera]
    numbers: Sequence[int]
    masks: bool
    held_out: Sequence[str]

    def write_backup(self) -> None:
        """Write `BACKUP_FILE`: what is known without tracking."""
        frames = [
            {key: value for key, value in frame.items() if key != "flame_param_path"}
            for frame in self._frames(np.zeros(3))
        ]
        write_json(self.folder / BACKUP_FILE, self._document(frames, np.zeros(3)))

    def write_tracked(self, tracked: TrackedSequence, declaration: layout.Declaration) -> None:
        """Write parameters, declaration and the four JSONs; all in the world whose mean translation is zero.

        The splits within the sequence are VHAP's: the first 70 % of the timesteps are training and novel
        views, the rest is test.
        """
        with grouped_writes():
            for timestep in range(tracked.count):
                path = self.folder / "flame_param" / f"{timestep:05d}.npz"
                save_npz(path, tracked.parameters(timestep))
        save_npz(self.folder / layout.CANONICAL_FILE, tracked.canonical())
        declaration.write(self.folder)
        frames = self._frames(tracked.shift)
        boundary = math.ceil(TRAIN_FRACTION * len(self.numbers))
        parts = _empty_parts()
        for frame in frames:
            held_out = frame["camera_id"] in self.held_out
            parts[split_of(test=frame["timestep_index"] >= boundary, held_out_camera=held_out)].append(frame)
        for name, file in layout.SPLIT_FILES.items():
            write_json(self.folder / file, self._document(parts[name], tracked.shift))
        write_json(self.folder / layout.ALL_FRAMES_FILE, self._document(frames, tracked.shift))

    def _document(self, frames: Sequence[Mapping[str, Any]], shift: FloatArray) -> dict[str, Any]:
        return transforms_document(frames, layout.intrinsics_to_json(_moved(self.cameras[-1], shift), CY))

    def _frames(self, shift: FloatArray) -> list[dict[str, Any]]:
        """Frame records, timestep outer, camera inner, key order of VHAP's sequence export."""
        cameras = [camera_record(_moved(camera, shift), i, CY) for i, camera in enumerate(self.cameras)]
        return [
            {
                "timestep_index": timestep,
                "timestep_index_original": timestep,
                "timestep_id": f"{number:06d}",
                **camera,
                **file_record(timestep, camera["camera_index"], "", mask=self.masks),
            }
            for timestep, number in enumerate(self.numbers)
            for camera in cameras
        ]


def _moved(camera: Camera, shift: FloatArray) -> Camera:
    """The camera in a world whose origin is at ``shift``."""
    matrix = camera.world_to_camera.copy()
    matrix[:3, 3] += matrix[:3, :3] @ shift
    return replace(camera, world_to_camera=matrix)


def _empty_parts() -> dict[str, list[dict[str, Any]]]:
    return {name: [] for name in layout.SPLIT_FILES}


def write_union(
    union: Path,
    train: Sequence[Path],
    test: Sequence[Path],
    held_out: Sequence[str],
    declaration: layout.Declaration | None,
) -> dict[str, int]:
    """Join sequence folders, ours or VHAP's, into a union beside them; return the frames per split.

    Timesteps are renumbered, training sequences first; nothing is copied. Frames of ``test`` are for
    self-reenactment, with all cameras; of ``train``, the ``held_out`` cameras are for novel views.
    """
    parts = _empty_parts()
    start = 0
    shared: dict[str, Any] = {}
    for folder in (*train, *test):
        path = folder / layout.ALL_FRAMES_FILE
        entries = read_transforms(path)
        document = read_json(path)
        shared = {k: v for k, v in document.items() if k not in ("frames", *_INDEX_KEYS)}
        for entry, frame in zip(entries, document["frames"], strict=True):
            record = _renumbered(frame, start, folder.name)
            is_held_out = entry.camera_id in held_out
            parts[split_of(test=folder in test, held_out_camera=is_held_out)].append(record)
        start += 1 + max((frame["timestep_index"] for frame in document["frames"]), default=-1)
    for file, group in ((layout.TRAIN_SEQUENCES_FILE, train), (layout.TEST_SEQUENCES_FILE, test)):
        write_text(union / file, "".join(f"{folder.name}\n" for folder in group))
    canonical = (train[0] / layout.CANONICAL_FILE).read_bytes()
    with atomic_path(union / layout.CANONICAL_FILE) as temporary:
        temporary.write_bytes(canonical)
    if declaration is not None:
        declaration.write(union)
    # Training last: it is the file that readers recognise a capture by.
    for name, file in reversed(layout.SPLIT_FILES.items()):
        write_json(union / file, transforms_document(parts[name], shared))
    return {name: len(frames) for name, frames in parts.items()}


_INDEX_KEYS = ("timestep_indices", "camera_indices")
_PATH_KEYS = ("file_path", "fg_mask_path", "flame_param_path")
_SINGLE_SEQUENCE_KEYS = ("timestep_index_original", "timestep_id")


def _renumbered(frame: Mapping[str, Any], start: int, folder: str) -> dict[str, Any]:
    record = {key: value for key, value in frame.items() if key not in _SINGLE_SEQUENCE_KEYS}
    record["timestep_index"] = start + record["timestep_index"]
    for key in _PATH_KEYS:
        if key in record:
            record[key] = f"../{folder}/{record[key]}"
    return record


@dataclass(frozen=True)
class UnionReport:
    """What a union folder holds.

    Attributes
    ----------
    fault : the first fault, or "".
    notes : what is unusual, though readable.
    free : the sequence folder of FREE beside it, or "".
    rejoined : the union of the paper's split that was written, or "".
    """

    subject: str
    folder: str = ""
    train: tuple[str, ...] = ()
    test: tuple[str, ...] = ()
    timesteps: int = 0
    cameras: int = 0
    fault: str = ""
    notes: tuple[str, ...] = ()
    free: str = ""
    rejoined: str = ""


def check_unions(
    root: Path, subjects: Sequence[str], *, rejoin: bool = False, progress: Progress = no_progress
) -> Findings:
    """Check the union of each subject under ``root``; with ``rejoin`` write those of the paper's split too.

    Passed where every subject has one and all are whole.
    """
    if not root.is_dir():
        raise InputError(root, "", "a folder of UNION folders", "a file" if root.exists() else "nothing")
    reports = []
    for done, subject in enumerate(subjects):
        progress(done, len(subjects), subject)
        reports.append(_report(root, subject, rejoin))
    lines = [f"{'subject':8} {'timesteps':>9} {'cameras':>7}  {'test':20} FREE  folder"]
    for report in reports:
        row = f"{report.timesteps:9} {report.cameras:7}  {','.join(report.test)[:20]:20} "
        row += f"{'yes' if report.free else 'no':4}  {report.folder}"
        lines.append(f"{report.subject:8} " + (row if not report.fault else f"FAULT: {report.fault}"))
        lines += [f"{'':8} note: {note}" for note in report.notes]
        if report.rejoined:
            lines.append(f"{'':8} paper's split: {report.rejoined}")
    passed = not any(report.fault for report in reports)
    return Findings("\n".join(lines), {report.subject: vars(report) for report in reports}, passed)


def _report(root: Path, subject: str, rejoin: bool) -> UnionReport:
    try:
        folder = _find(root, subject)
        entries = {name: read_transforms(folder / file) for name, file in layout.SPLIT_FILES.items()}
        everything = [entry for part in entries.values() for entry in part]
        check_timesteps(folder, everything)
        check_images(everything)
    except InputError as error:
        return UnionReport(subject, fault=str(error))
    test = _sequences(entries["self_reenactment"])
    train = _sequences(entries["train"] + entries["novel_view"])
    free = next(iter(sorted(path.name for path in root.glob(f"{subject}_{TEST_SEQUENCE}_*"))), "")
    rejoined = ""
    if rejoin:
        try:
            rejoined = rejoin_union(root, subject, everything, free)
        except InputError as error:
            return UnionReport(subject, folder.name, fault=str(error))
    return UnionReport(
        subject=subject,
        folder=folder.name,
        train=train,
        test=test,
        timesteps=len(timesteps_of(everything)),
        cameras=len({entry.camera_id for entry in everything}),
        notes=tuple(_notes(subject, test, entries)),
        free=free,
        rejoined=rejoined,
    )


def _find(root: Path, subject: str) -> Path:
    """The subject's union; one of the paper's split that we wrote earlier does not count."""
    fitting = [
        path
        for path in sorted(root.glob("UNION*"))
        if path.is_dir()
        and layout.parse_union_folder(path.name) == subject
        and not path.name.endswith(_REJOINED)
    ]
    if len(fitting) != 1:
        found = ", ".join(path.name for path in fitting) or "none"
        raise InputError(root, subject, f"one folder UNION10_{subject}_...", found)
    return fitting[0]


def _sequences(entries: Sequence[FrameEntry]) -> tuple[str, ...]:
    folders = dict.fromkeys(entry.sequence_folder for entry in entries)
    return tuple(layout.parse_sequence_folder(folder)[1] for folder in folders)


def _notes(subject: str, test: Sequence[str], entries: dict[str, list[FrameEntry]]) -> list[str]:
    notes = []
    expected = union10_held_out(subject)
    if not any(expected == name or expected.startswith(f"{name}-") for name in test):
        notes.append(f"test holds {', '.join(test) or 'nothing'}; VHAP's rule would hold out {expected}")
    views = {entry.camera_id for entry in entries["novel_view"]}
    # Older exports name cameras by their index alone.
    indices = {entry.camera_index for entry in entries["novel_view"]}
    if views and NOVEL_VIEW_CAMERA not in views and indices != {FRONTAL_INDEX}:
        notes.append(f"novel views are of {', '.join(sorted(views))}, not of the frontal {NOVEL_VIEW_CAMERA}")
    if not views:
        notes.append("no novel views")
    return notes


_REJOINED = "_rejoined"


def rejoin_union(root: Path, subject: str, entries: Sequence[FrameEntry], free: str) -> str:
    """Write the union of the paper's split beside the others: all sequences of a union, and FREE as the test.

    Returns the folder's name. Raises `InputError` where FREE is not there.
    """
    if not free:
        expected = f"a sequence folder {subject}_{TEST_SEQUENCE}_..., exported with its parameters"
        raise InputError(root, subject, expected, "none")
    folders = dict.fromkeys(entry.sequence_folder for entry in entries)
    named = {layout.parse_sequence_folder(folder)[1]: folder for folder in folders if folder != free}
    order = {match_sequence(root, name, UNION10_SEQUENCES): folder for name, folder in named.items()}
    train = [root / order[name] for name in UNION10_SEQUENCES if name in order]
    union = root / f"UNION{len(train) + 1}_{subject}{_REJOINED}"
    write_union(union, train, [root / free], _frontal(entries), None)
    return union.name


def _frontal(entries: Sequence[FrameEntry]) -> list[str]:
    """Ids of the camera for novel views: its serial, else the index that VHAP holds out."""
    by_index = {entry.camera_id for entry in entries if entry.camera_index == FRONTAL_INDEX}
    known = {entry.camera_id for entry in entries}
    return [NOVEL_VIEW_CAMERA] if NOVEL_VIEW_CAMERA in known else sorted(by_index)
