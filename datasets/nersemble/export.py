"""Metadata of a prepared sequence in the GaussianAvatars/VHAP layout, and the union of several."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...bench.contracts import Camera, FloatArray
from ...bench.io.documents import read_json
from ...bench.io.files import atomic_path, grouped_writes, write_json, write_text
from ..ga import layout
from ..ga.documents import camera_record, file_record, save_npz, split_of, transforms_document
from ..ga.transforms import read_transforms
from ..ga.writer import TRAIN_FRACTION
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
