"""Write a capture in the GaussianAvatars/VHAP layout, resumable after every image.

Images are written first, in any order and over several runs; `CaptureWriter.write_metadata` then checks that all exist
and writes parameters and JSONs, those of the union last, so a folder with a union JSON is a complete capture.

Write a clip with other tracking as a new capture; PNG files that no step changes are linked.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeGuard

import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray, FrameKey, HeadPose, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.documents import read_json
from ...bench.io.files import atomic_path, write_bytes, write_json, write_text
from ...bench.io.images import probe_image
from ...bench.manifest import cut_of
from ..clip import CaptureClip
from ..head.arrays import HeadArrays, save_head
from ..images import write_image
from . import layout
from .tracking import pose_to_parameters
from .transforms import read_transforms
from .validate import require_full_grid


def camera_record(camera: Camera, index: int, cy: layout.CyConvention) -> dict[str, Any]:
    """The camera entries of a frame record, with keys in VHAP's order."""
    return {
        "camera_index": index,
        "camera_id": camera.id,
        **layout.intrinsics_to_json(camera, cy),
        "transform_matrix": layout.extrinsics_to_json(camera.world_to_camera),
    }


def file_record(timestep: int, camera_index: int, *, mask: bool) -> dict[str, str]:
    """Paths of a frame's files, relative to the sequence's folder."""
    name = layout.frame_name(timestep, camera_index)
    masks = {"fg_mask_path": f"fg_masks/{name}.png"} if mask else {}
    parameters = f"{layout.TRACKING_FOLDER}/{layout.parameter_name(timestep)}"
    return {"file_path": f"images/{name}.png", **masks, "flame_param_path": parameters}


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


def write_sequence(
    folder: Path,
    frames: Sequence[dict[str, Any]],
    shared: Mapping[str, float | int],
    held_out: Sequence[str],
    declaration: layout.Declaration,
    test: Collection[int] = (),
) -> None:
    """Write a sequence's declaration and its four JSONs.

    The splits within the sequence are VHAP's: the first 70 % of the timesteps are training and, of the ``held_out``
    cameras, novel views; the rest is test. If ``test`` is not empty, its timesteps are test instead.
    """
    declaration.write(folder)
    count = 1 + max(frame["timestep_index"] for frame in frames)
    test = test or range(math.ceil(TRAIN_FRACTION * count), count)
    placed = ((frame, frame["timestep_index"] in test, frame["camera_id"] in held_out) for frame in frames)
    _write_splits(folder, placed, shared)
    write_json(folder / layout.ALL_FRAMES_FILE, transforms_document(frames, shared))


def write_union(
    union: Path,
    train: Sequence[Path],
    test: Sequence[Path],
    held_out: Sequence[str],
    declaration: layout.Declaration | None,
    partly: Mapping[Path, Collection[int]] = MappingProxyType({}),
) -> dict[str, int]:
    """Join sequence folders of headbench or VHAP into a union beside them; return the number of frames per split.

    Timesteps are renumbered, training sequences first; nothing is copied. Frames of ``test`` are for
    self-reenactment, with all cameras, as are the timesteps in ``partly`` of folders in ``train``; for the other
    timesteps of these, the ``held_out`` cameras are for novel views.
    """
    placed: list[tuple[dict[str, Any], bool, bool]] = []
    start = 0
    shared: dict[str, Any] = {}
    for folder in (*train, *test):
        path = folder / layout.ALL_FRAMES_FILE
        document = read_json(path)
        shared = {
            k: v for k, v in document.items() if k not in ("frames", "timestep_indices", "camera_indices")
        }
        entries = read_transforms(path)
        for entry, frame in zip(entries, document["frames"], strict=True):
            record = {key: value for key, value in frame.items() if key not in _SINGLE_SEQUENCE_KEYS}
            tested = folder in test or entry.timestep in partly.get(folder, ())
            record |= {"timestep_index": start + entry.timestep, "camera_index": entry.camera_index}
            paths = {
                "file_path": entry.image,
                "fg_mask_path": entry.mask,
                "flame_param_path": entry.parameters,
            }
            record |= {key: Path(os.path.relpath(p, union)).as_posix() for key, p in paths.items() if p}
            placed.append((record, tested, entry.camera_id in held_out))
        start += 1 + max((entry.timestep for entry in entries), default=-1)
    for file, group in ((layout.TRAIN_SEQUENCES_FILE, train), (layout.TEST_SEQUENCES_FILE, test)):
        write_text(union / file, "".join(f"{folder.name}\n" for folder in group))
    write_bytes(union / layout.CANONICAL_FILE, (train[0] / layout.CANONICAL_FILE).read_bytes())
    if declaration is not None:
        declaration.write(union)
    return _write_splits(union, placed, shared)


_SINGLE_SEQUENCE_KEYS = ("timestep_index_original", "timestep_id")


def _write_splits(
    folder: Path, frames: Iterable[tuple[dict[str, Any], bool, bool]], shared: Mapping[str, float | int]
) -> dict[str, int]:
    """Write the JSON of each split from (frame, whether it is test, whether of a held-out camera)."""
    parts: dict[str, list[dict[str, Any]]] = {name: [] for name in layout.SPLIT_FILES}
    for frame, test, held_out in frames:
        parts["self_reenactment" if test else "novel_view" if held_out else "train"].append(frame)
    # Training is written last because readers recognise a capture by this file.
    for name, file in reversed(layout.SPLIT_FILES.items()):
        write_json(folder / file, transforms_document(parts[name], shared))
    return {name: len(part) for name, part in parts.items()}


def save_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write an uncompressed npz atomically; equal arrays make equal bytes."""
    with atomic_path(path) as temporary:
        np.savez(temporary, allow_pickle=False, **arrays)


CANONICAL_JAW = (0.3, 0.0, 0.0)
"""Axis-angle of the open mouth that VHAP stores in the canonical parameters, radians."""

TRAIN_FRACTION = 0.7
"""Fraction of a single sequence's timesteps that VHAP uses for training and novel views; the rest is test."""


@dataclass(frozen=True, eq=False)
class SequencePlan:
    """One sequence of a capture: its poses, one per timestep from 0, and the frames to leave out.

    ``excluded`` maps a timestep of this sequence to the reason, such as "tongue out". ``held_out`` are timesteps for
    self-reenactment in a training sequence, such as the end of a video.
    """

    name: str
    poses: Sequence[HeadPose]
    excluded: Mapping[int, str] = field(default_factory=dict)
    held_out: frozenset[int] = frozenset()


@dataclass(frozen=True, eq=False)
class CapturePlan:
    """Everything in a capture except its images."""

    subject: str
    """Subject id, without underscores because folder names are parsed by them."""
    head: HeadArrays
    """Head model of all poses; V vertices, S identity coefficients."""
    shape: FloatArray
    """(S,) identity coefficients."""
    static_offset: FloatArray
    """(V, 3) metres."""
    cameras: Sequence[Camera]
    """In index order; the index is the position."""
    sequences: Sequence[SequencePlan]
    """In any order; the union numbers training sequences first."""
    test_sequences: Sequence[str]
    """Names of the sequences held out for self-reenactment."""
    novel_view_cameras: Sequence[str]
    """Ids of the cameras held out for novel views."""
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """(r, g, b) in [0, 1] that images are composited on."""
    cy: layout.CyConvention = "bottom"
    """Convention of the principal point in the JSONs; VHAP's is "bottom"."""
    synthetic: Mapping[str, Any] = field(default_factory=dict)
    """How the capture was synthesised (seed, noise, ...); empty for a recording."""
    cut: str = ""

    def __post_init__(self) -> None:
        if "_" in self.subject:
            raise InputError("capture plan", "subject", "a name without underscores", repr(self.subject))
        if {*self.test_sequences} == {sequence.name for sequence in self.sequences}:
            raise InputError("capture plan", "test_sequences", "a training sequence left", "none left")

    def sequence(self, name: str) -> SequencePlan:
        """The sequence of that name."""
        return next(sequence for sequence in self.sequences if sequence.name == name)


class CaptureWriter:
    """Writes the capture of a plan under ``root``: a union folder and its sibling sequence folders."""

    def __init__(self, root: Path, plan: CapturePlan):
        self.root, self.plan = Path(root), plan
        self._camera_index = {camera.id: index for index, camera in enumerate(plan.cameras)}

    @property
    def union(self) -> Path:
        """The folder to give to a reader."""
        return self.root / f"UNION{len(self.plan.sequences)}_{self.plan.subject}"

    def sequence_folder(self, sequence: str) -> Path:
        """Folder of a sequence, named in VHAP's manner: ``074_EMO-1-shout+laugh_v16_whiteBg_staticOffset``."""
        return self.root / f"{self.plan.subject}_{sequence}_v{len(self.plan.cameras)}_whiteBg_staticOffset"

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
        """Write one image, (H, W, 3) RGB or (H, W, 4) straight-alpha RGBA, and its (H, W) mask. Each is written
        atomically, the image last, so a frame with an existing image is complete."""
        if mask is not None:
            write_image(self.mask_path(sequence, timestep, camera), mask)
        write_image(self.image_path(sequence, timestep, camera), image)

    def write_metadata(self) -> Path:
        """Write parameters, JSONs and the head model; return the union folder."""
        plan = self.plan
        for sequence in plan.sequences:
            for timestep in range(len(sequence.poses)):
                for camera in plan.cameras:
                    path = self.image_path(sequence.name, timestep, camera.id)
                    info = probe_image(path)
                    if (info.width, info.height) != (camera.width, camera.height):
                        size = f"{camera.width}x{camera.height} pixels, the size of camera {camera.id}"
                        raise InputError(path, "", size, f"{info.width}x{info.height}")
        for sequence in plan.sequences:
            self._write_sequence(sequence)
        save_head(self.union / layout.HEAD_FILE, plan.head)
        train = [s for s in plan.sequences if s.name not in plan.test_sequences]
        test = [s for s in plan.sequences if s.name in plan.test_sequences]
        write_union(
            self.union,
            [self.sequence_folder(sequence.name) for sequence in train],
            [self.sequence_folder(sequence.name) for sequence in test],
            plan.novel_view_cameras,
            self._declaration([*train, *test], layout.HEAD_FILE),
            {self.sequence_folder(sequence.name): sequence.held_out for sequence in train},
        )
        return self.union

    def _write_sequence(self, sequence: SequencePlan) -> None:
        plan, folder = self.plan, self.sequence_folder(sequence.name)
        identity = identity_parameters(plan.shape, plan.static_offset)
        for timestep, pose in enumerate(sequence.poses):
            path = folder / layout.TRACKING_FOLDER / layout.parameter_name(timestep)
            save_npz(path, pose_to_parameters(pose) | identity)
        zeros = {k: np.zeros_like(v) for k, v in pose_to_parameters(plan.sequences[0].poses[0]).items()}
        zeros["jaw_pose"] = np.array([CANONICAL_JAW], dtype=np.float64)
        save_npz(folder / layout.CANONICAL_FILE, zeros | identity)
        frames = [  # timestep outer, camera inner, keys in the order of VHAP's union export
            {
                "timestep_index": timestep,
                **camera_record(camera, index, plan.cy),
                **file_record(
                    timestep, index, mask=self.mask_path(sequence.name, timestep, camera.id).exists()
                ),
                "timestep_index_original": timestep,
                "timestep_id": f"{timestep:06d}",
            }
            for timestep in range(len(sequence.poses))
            for index, camera in enumerate(plan.cameras)
        ]
        shared = layout.intrinsics_to_json(plan.cameras[-1], plan.cy)
        declaration = self._declaration([sequence], f"../{self.union.name}/{layout.HEAD_FILE}")
        write_sequence(folder, frames, shared, plan.novel_view_cameras, declaration, sequence.held_out)

    def _declaration(self, sequences: Sequence[SequencePlan], head_file: str) -> layout.Declaration:
        starts = np.cumsum([0, *(len(sequence.poses) for sequence in sequences)]).tolist()
        return layout.Declaration(
            subject=self.plan.subject,
            head_model=self.plan.head.version,
            head_file=head_file,
            background=self.plan.background,
            cy=self.plan.cy,
            sequences={self.sequence_folder(s.name).name: s.name for s in sequences},
            excluded={
                start + timestep: reason
                for start, sequence in zip(starts, sequences)
                for timestep, reason in sequence.excluded.items()
            },
            synthetic=self.plan.synthetic,
            cut=self.plan.cut,
        )


def identity_parameters(shape: FloatArray, static_offset: FloatArray) -> dict[str, FloatArray]:
    """Part of a ``flame_param`` file that is the same for all timesteps, float32."""
    return {"shape": shape.astype(np.float32), "static_offset": static_offset[None].astype(np.float32)}


def write_capture(clip: CaptureClip, out: Path, progress: Progress = no_progress) -> Path:
    """Write the clip under ``out`` in the GaussianAvatars/VHAP layout; return the union folder.

    Frames keep their sequence and camera; splits, exclusions and background are unchanged. The timesteps of a sequence
    are renumbered from 0 without a gap, as the layout requires.
    """
    plan, index = capture_plan(clip)
    writer = CaptureWriter(out, plan)
    for done, (key, files) in enumerate(sorted(clip.files.items())):
        progress(done, len(clip.files), "writing images")
        place = (key.sequence, index[key.timestep], key.camera)
        if clip.pixel_steps or not _is_png(files.image) or not (files.mask is None or _is_png(files.mask)):
            writer.write_frame(*place, clip.image(key), clip.mask(key))
            continue
        if files.mask is not None:
            link_or_copy(files.mask, writer.mask_path(*place))
        link_or_copy(files.image, writer.image_path(*place))
    return writer.write_metadata()


def capture_plan(clip: CaptureClip, source: str | Path = "") -> tuple[CapturePlan, dict[int, int]]:
    """Plan of the capture for a clip, and each timestep's number in its sequence."""
    where = str(source) or f"clip of {clip.subject}"
    require_full_grid(clip, where)
    _check_excluded(clip, where)
    timesteps: dict[str, list[int]] = {}  # of each sequence, in order; sequences by their first
    for timestep, name in sorted({(key.timestep, key.sequence) for key in clip.files}):
        timesteps.setdefault(name, []).append(timestep)
    index = {timestep: number for found in timesteps.values() for number, timestep in enumerate(found)}
    novel = {key.camera for key in clip.splits["novel_view"]}
    held: dict[str, set[int]] = {}  # timesteps of each sequence in the capture written
    for key in clip.splits["self_reenactment"]:
        held.setdefault(key.sequence, set()).add(index[key.timestep])
    for split, keys in clip.splits.items():
        for key in keys:
            placed = "novel_view" if key.camera in novel else "train"
            if split != ("self_reenactment" if index[key.timestep] in held.get(key.sequence, ()) else placed):
                expected = "splits by held-out timesteps and cameras, which the layout can represent"
                raise InputError(where, "splits", expected, f"{key} in {split}")
    shared = {key.sequence for name in ("train", "novel_view") for key in clip.splits[name]}
    background = tuple(float(value) for value in clip.background)
    sequences = [
        SequencePlan(
            name,
            [clip.poses[timestep] for timestep in found],
            {index[k.timestep]: why for k, why in clip.excluded.items() if k.sequence == name},
            frozenset(held.get(name, ())) if name in shared else frozenset(),
        )
        for name, found in timesteps.items()
    ]
    plan = CapturePlan(
        subject=clip.subject,
        head=clip.head,
        shape=clip.shape,
        static_offset=clip.static_offset,
        cameras=[*clip.cameras.values()],
        sequences=sequences,
        test_sequences=sorted(held.keys() - shared),
        novel_view_cameras=sorted(novel),
        background=(background[0], background[1], background[2]),
        synthetic=clip.steps[0].parameters.get("synthetic", {}) if clip.steps else {},
        cut=cut_of(map(asdict, clip.steps)),
    )
    return plan, index


def link_or_copy(source: Path, target: Path) -> None:
    """Link ``target`` to ``source``, or copy it if the file system does not support links; atomically."""
    if target.exists() and os.path.samefile(source, target):
        return
    with atomic_path(target) as temporary:
        temporary.unlink()
        try:
            os.link(source, temporary)
        except OSError:
            shutil.copyfile(source, temporary)


def _is_png(path: Path | None) -> TypeGuard[Path]:
    return path is not None and path.suffix.lower() == ".png"


def _check_excluded(clip: CaptureClip, where: str) -> None:
    """Check exclusions: the layout can exclude only whole timesteps, each for one reason."""
    of_timestep: dict[int, FrameKey] = {}
    for key in sorted(clip.files):
        first = of_timestep.setdefault(key.timestep, key)
        found, other = clip.excluded.get(key), clip.excluded.get(first)
        if found != other:
            expected = f"timestep {key.timestep} excluded with all its cameras for one reason, or not at all"
            said = {first: other, key: found}
            parts = [f"{one} {'kept' if why is None else f'excluded: {why}'}" for one, why in said.items()]
            raise InputError(where, "excluded", expected, " and ".join(parts))
