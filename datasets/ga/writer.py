"""Write a capture in the GaussianAvatars/VHAP layout, image by image and resumably.

Images come first, in any order and over several runs; `CaptureWriter.write_metadata` then checks that all are
there and writes parameters and JSONs, the union's last: a folder with a union JSON is a whole capture.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray, HeadPose
from ...bench.errors import InputError
from ...bench.io.files import atomic_path, grouped_writes, write_json, write_text
from ...bench.io.images import probe_image
from ..head.arrays import HeadArrays, save_head
from ..images import write_image
from . import layout


def camera_record(camera: Camera, index: int, cy: layout.CyConvention) -> dict[str, Any]:
    """The camera's part of a frame record, keys in VHAP's order."""
    return {
        "camera_index": index,
        "camera_id": camera.id,
        **layout.intrinsics_to_json(camera, cy),
        "transform_matrix": layout.extrinsics_to_json(camera.world_to_camera),
    }


def file_record(timestep: int, camera_index: int, prefix: str, *, mask: bool) -> dict[str, str]:
    """Paths of a frame's files, relative to the JSON; ``prefix`` leads to the sequence's folder."""
    name = layout.frame_name(timestep, camera_index)
    masks = {"fg_mask_path": f"{prefix}fg_masks/{name}.png"} if mask else {}
    return {
        "file_path": f"{prefix}images/{name}.png",
        **masks,
        "flame_param_path": f"{prefix}flame_param/{timestep:05d}.npz",
    }


def transforms_document(
    frames: Sequence[Mapping[str, Any]], shared: Mapping[str, float | int]
) -> dict[str, Any]:
    """A transforms JSON: frames, the shared intrinsics (those of the last camera), and the indices in use."""
    return {
        "frames": frames,
        **shared,
        "timestep_indices": sorted({frame["timestep_index"] for frame in frames}),
        "camera_indices": sorted({frame["camera_index"] for frame in frames}),
    }


def split_of(*, test: bool, held_out_camera: bool) -> str:
    """Name of the split a frame belongs to."""
    if test:
        return "self_reenactment"
    return "novel_view" if held_out_camera else "train"


def save_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write an uncompressed npz atomically; equal arrays make equal bytes."""
    with atomic_path(path) as temporary:
        np.savez(temporary, allow_pickle=False, **arrays)


CANONICAL_JAW = (0.3, 0.0, 0.0)
"""Axis-angle of the open mouth that VHAP stores in the canonical parameters, radians."""

TRAIN_FRACTION = 0.7
"""Part of a single sequence's timesteps that VHAP gives to training and novel views; the rest is test."""


@dataclass(frozen=True, eq=False)
class SequencePlan:
    """One sequence of a capture: its poses, one per timestep from 0, and the frames to leave out.

    ``excluded`` maps a timestep of this sequence to the reason, such as "tongue out".
    """

    name: str
    poses: Sequence[HeadPose]
    excluded: Mapping[int, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class CapturePlan:
    """Everything of a capture but its images.

    Attributes
    ----------
    subject : subject id, without underscores, as folder names are parsed by them.
    head : head model of all poses; V vertices, S identity coefficients.
    shape : (S,) identity coefficients.
    static_offset : (V, 3) metres.
    cameras : in index order; the index is the position.
    sequences : in any order; the union numbers training sequences first.
    test_sequences : names of the sequences held out for self-reenactment.
    novel_view_cameras : ids of the cameras held out for novel views.
    background : (r, g, b) in [0, 1] that images are composited on.
    cy : how the JSONs state the principal point; VHAP's own is "bottom".
    synthetic : how the capture was synthesised (seed, noise, ...); empty for a recording.
    """

    subject: str
    head: HeadArrays
    shape: FloatArray
    static_offset: FloatArray
    cameras: Sequence[Camera]
    sequences: Sequence[SequencePlan]
    test_sequences: Sequence[str]
    novel_view_cameras: Sequence[str]
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    cy: layout.CyConvention = "bottom"
    synthetic: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = [sequence.name for sequence in self.sequences]
        ids = [camera.id for camera in self.cameras]
        vertices, _, identities = self.head.shape_basis.shape
        _require(len(set(names)) == len(names) > 0, "sequences", "distinct names, at least one", f"{names}")
        _require(len(set(ids)) == len(ids) > 0, "cameras", "distinct ids, at least one", f"{ids}")
        _require(bool(self.subject), "subject", "a name", "none")
        _require("_" not in self.subject, "subject", "a name without underscores", repr(self.subject))
        _require(self.shape.shape == (identities,), "shape", f"({identities},)", f"{self.shape.shape}")
        _require(
            self.static_offset.shape == (vertices, 3),
            "static_offset",
            f"({vertices}, 3)",
            f"{self.static_offset.shape}",
        )
        unknown = sorted({*self.test_sequences} - {*names})
        _require(not unknown, "test_sequences", f"names out of {names}", f"{unknown}")
        unknown = sorted({*self.novel_view_cameras} - {*ids})
        _require(not unknown, "novel_view_cameras", f"ids out of {ids}", f"{unknown}")
        _require(
            {*self.test_sequences} != {*names}, "test_sequences", "a training sequence left", "none left"
        )
        versions = {pose.head_model for sequence in self.sequences for pose in sequence.poses}
        _require(
            versions == {self.head.version},
            "sequences",
            f"poses of head model {self.head.version}",
            f"{sorted(versions)}",
        )

    def sequence(self, name: str) -> SequencePlan:
        """The sequence of that name."""
        return next(sequence for sequence in self.sequences if sequence.name == name)


def _require(condition: bool, key: str, expected: str, found: str) -> None:
    if not condition:
        raise InputError("capture plan", key, expected, found)


class CaptureWriter:
    """Writes the capture of a plan under ``root``: one union folder and its sibling sequence folders."""

    def __init__(self, root: Path, plan: CapturePlan):
        self.root, self.plan = Path(root), plan
        self._camera_index = {camera.id: index for index, camera in enumerate(plan.cameras)}

    @property
    def union(self) -> Path:
        """The folder to give to a reader."""
        return self.root / f"UNION{len(self.plan.sequences)}_{self.plan.subject}"

    def sequence_folder(self, sequence: str) -> Path:
        """Folder of a sequence."""
        name = layout.sequence_folder_name(self.plan.subject, sequence, len(self.plan.cameras))
        return self.root / name

    def image_path(self, sequence: str, timestep: int, camera: str) -> Path:
        """File of an image; ``timestep`` counts from 0 within the sequence."""
        return self._frame_path("images", sequence, timestep, camera)

    def mask_path(self, sequence: str, timestep: int, camera: str) -> Path:
        """File of a foreground mask."""
        return self._frame_path("fg_masks", sequence, timestep, camera)

    def _frame_path(self, folder: str, sequence: str, timestep: int, camera: str) -> Path:
        name = layout.frame_name(timestep, self._camera_index[camera])
        return self.sequence_folder(sequence) / folder / f"{name}.png"

    def write_frame(
        self, sequence: str, timestep: int, camera: str, image: ByteArray, mask: ByteArray | None = None
    ) -> None:
        """Write one image, (H, W, 3) RGB or (H, W, 4) straight-alpha RGBA, and its (H, W) mask.

        Each is written atomically and the image last: a frame whose image exists is whole.
        """
        if mask is not None:
            write_image(self.mask_path(sequence, timestep, camera), mask)
        write_image(self.image_path(sequence, timestep, camera), image)

    def write_metadata(self) -> Path:
        """Write parameters, JSONs and the head model; return the union folder.

        Raises `InputError` naming the first image that is missing, broken or of the wrong size.
        """
        self._check_images()
        for sequence in self.plan.sequences:
            self._write_sequence(sequence)
        self._write_union()
        return self.union

    def _check_images(self) -> None:
        for sequence in self.plan.sequences:
            for timestep in range(len(sequence.poses)):
                for camera in self.plan.cameras:
                    path = self.image_path(sequence.name, timestep, camera.id)
                    info = probe_image(path)
                    if (info.width, info.height) != (camera.width, camera.height):
                        size = f"{camera.width}x{camera.height} pixels, the size of camera {camera.id}"
                        raise InputError(path, "", size, f"{info.width}x{info.height}")

    def _write_sequence(self, sequence: SequencePlan) -> None:
        folder = self.sequence_folder(sequence.name)
        constant = identity_parameters(self.plan.shape, self.plan.static_offset)
        with grouped_writes():
            for timestep, pose in enumerate(sequence.poses):
                save_npz(
                    folder / "flame_param" / layout.parameter_name(timestep),
                    pose_to_parameters(pose) | constant,
                )
        self._write_canonical(folder)
        boundary = math.ceil(TRAIN_FRACTION * len(sequence.poses))
        frames = list(self._frames(sequence, 0, ""))
        for record in frames:
            timestep = record["timestep_index"]
            record["timestep_index_original"] = timestep
            record["timestep_id"] = f"{timestep:06d}"
        held_out = {self._camera_index[camera] for camera in self.plan.novel_view_cameras}
        parts: dict[str, list[dict[str, Any]]] = {name: [] for name in layout.SPLIT_FILES}
        for record in frames:
            split = split_of(
                test=record["timestep_index"] >= boundary, held_out_camera=record["camera_index"] in held_out
            )
            parts[split].append(record)
        self._declaration([sequence], f"../{self.union.name}/{layout.HEAD_FILE}").write(folder)
        for name, file in layout.SPLIT_FILES.items():
            self._write_transforms(folder / file, parts[name])
        self._write_transforms(folder / layout.ALL_FRAMES_FILE, frames)

    def _write_union(self) -> None:
        test = [s for s in self.plan.sequences if s.name in self.plan.test_sequences]
        train = [s for s in self.plan.sequences if s.name not in self.plan.test_sequences]
        held_out = {self._camera_index[camera] for camera in self.plan.novel_view_cameras}
        parts: dict[str, list[dict[str, Any]]] = {name: [] for name in layout.SPLIT_FILES}
        start = 0
        for sequence in [*train, *test]:
            for record in self._frames(sequence, start, f"../{self.sequence_folder(sequence.name).name}/"):
                split = split_of(test=sequence in test, held_out_camera=record["camera_index"] in held_out)
                parts[split].append(record)
            start += len(sequence.poses)
        for file, group in ((layout.TRAIN_SEQUENCES_FILE, train), (layout.TEST_SEQUENCES_FILE, test)):
            names = (self.sequence_folder(sequence.name).name for sequence in group)
            write_text(self.union / file, "".join(f"{name}\n" for name in names))
        self._write_canonical(self.union)
        save_head(self.union / layout.HEAD_FILE, self.plan.head)
        self._declaration([*train, *test], layout.HEAD_FILE).write(self.union)
        # Training last: it is the file that readers recognise a capture by.
        for name, file in reversed(layout.SPLIT_FILES.items()):
            self._write_transforms(self.union / file, parts[name])

    def _frames(self, sequence: SequencePlan, start: int, prefix: str) -> Iterable[dict[str, Any]]:
        """Frame records, timestep outer, camera inner, with the key order of VHAP's union export."""
        for timestep in range(len(sequence.poses)):
            for index, camera in enumerate(self.plan.cameras):
                mask = self.mask_path(sequence.name, timestep, camera.id).exists()
                yield {
                    "timestep_index": start + timestep,
                    **camera_record(camera, index, self.plan.cy),
                    **file_record(timestep, index, prefix, mask=mask),
                }

    def _write_transforms(self, path: Path, frames: Sequence[Mapping[str, Any]]) -> None:
        shared = layout.intrinsics_to_json(self.plan.cameras[-1], self.plan.cy)
        write_json(path, transforms_document(frames, shared))

    def _write_canonical(self, folder: Path) -> None:
        pose = self.plan.sequences[0].poses[0]
        zeros = {key: np.zeros_like(value) for key, value in pose_to_parameters(pose).items()}
        zeros["jaw_pose"] = np.array([CANONICAL_JAW], dtype=np.float64)
        save_npz(
            folder / layout.CANONICAL_FILE,
            zeros | identity_parameters(self.plan.shape, self.plan.static_offset),
        )

    def _declaration(self, sequences: Sequence[SequencePlan], head_file: str) -> layout.Declaration:
        starts = np.cumsum([0, *(len(sequence.poses) for sequence in sequences)])
        return layout.Declaration(
            subject=self.plan.subject,
            head_model=self.plan.head.version,
            head_file=head_file,
            background=self.plan.background,
            cy=self.plan.cy,
            sequences={self.sequence_folder(s.name).name: s.name for s in sequences},
            excluded={
                int(start) + timestep: reason
                for start, sequence in zip(starts, sequences, strict=False)
                for timestep, reason in sequence.excluded.items()
            },
            synthetic=self.plan.synthetic,
        )


def pose_to_parameters(pose: HeadPose) -> dict[str, FloatArray]:
    """Per-timestep part of a ``flame_param`` file, float32; ``eyelids`` (ours) only where the pose has them."""
    parameters = {
        "translation": pose.translation,
        "rotation": pose.rotation,
        "neck_pose": pose.neck,
        "jaw_pose": pose.jaw,
        "eyes_pose": pose.eyes,
        "expr": pose.expression,
    }
    if pose.eyelids is not None:
        parameters["eyelids"] = pose.eyelids
    return {key: np.asarray(value, dtype=np.float32)[None] for key, value in parameters.items()}


def identity_parameters(shape: FloatArray, static_offset: FloatArray) -> dict[str, FloatArray]:
    """Part of a ``flame_param`` file that is the same for all timesteps, float32."""
    return {"shape": shape.astype(np.float32), "static_offset": static_offset[None].astype(np.float32)}
