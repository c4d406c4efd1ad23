"""Common files of mesh-bound avatars: head model, subject, refined tracking, and record of the run."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from torch import Tensor

from ...bench.configuration import build, deciding_settings
from ...bench.contracts import Budget, Clip, FloatArray, HeadAsset, HeadPose
from ...bench.engine.stored import HEAD_FILE, SUBJECT_FILE, TRAINING_FILE
from ...bench.errors import InputError
from ...bench.io.arrays import MAX_MAGNITUDE, TEXT, Member, read_arrays
from ...bench.io.documents import parse_json, read_json
from ...bench.io.files import atomic_path, digest, write_json
from ...datasets.head.arrays import OPTIONAL, STORED, HeadArrays, read_head, save_head
from .loop import Fit, TrainingSummary
from .surface_points import SubjectMesh
from .tensor_files import read_safetensors

Content = TypeVar("Content")
AVATAR_FILE = "avatar.safetensors"
"""The tensors of an avatar as its training leaves them."""
COMPACT_FILE = "compact.safetensors"
"""The coded file of an avatar (`avatars.compact`), which replaces the files written by training."""
RECORDED_LOSSES = 200  # maximum number of losses in an avatar's record
_SIZES = {"rotation": 3, "neck": 3, "jaw": 3, "eyes": 6, "translation": 3}
TRACKED = ("expression", "rotation", "neck", "jaw", "eyes", "translation")


@dataclass(frozen=True, eq=False)
class Subject:
    """Subject of an avatar: name, head model version, (S,) identity, (V, 3) static offset in metres."""

    name: str
    head_model: str
    shape: FloatArray
    static_offset: FloatArray

    @classmethod
    def of(cls, clip: Clip) -> Subject:
        """The subject of a clip in float32, as stored."""
        shape, offset = np.asarray(clip.shape, np.float32), np.asarray(clip.static_offset, np.float32)
        return cls(clip.subject, clip.head.version, shape, offset)


def clip_mesh(clip: Clip, device: str) -> SubjectMesh:
    """The mesh of a clip's subject, from values in float32, as stored."""
    subject = Subject.of(clip)
    return SubjectMesh(clip.head, subject.shape, subject.static_offset, device)


def head_arrays(head: HeadAsset) -> HeadArrays:
    """A head model as writable arrays for storage."""
    if isinstance(head, HeadArrays):
        return head
    names = ("version", *STORED, *OPTIONAL, "regions")
    return HeadArrays(**{name: getattr(head, name) for name in names if hasattr(head, name)})


def save_shared_head(folder: Path, head: HeadAsset) -> None:
    """Write the head model beside the avatar, so that the folder is self-contained. It is a shared asset."""
    save_head(folder / HEAD_FILE, head_arrays(head))


def read_shared_head(folder: Path) -> HeadArrays:
    """Read the head model beside an avatar."""
    return read_head(folder / HEAD_FILE)


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write an uncompressed npz atomically; equal arrays give equal bytes."""
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **{name: np.asarray(value) for name, value in arrays.items()})


def write_subject(path: Path, subject: Subject) -> None:
    """Write identity coefficients and static offset as float32 npz."""
    shape, offset = subject.shape.astype(np.float32), subject.static_offset.astype(np.float32)
    texts = {"name": subject.name, "head_model": subject.head_model}
    write_arrays(path, {**texts, "shape": shape, "static_offset": offset})


def read_subject(path: Path, head: HeadAsset) -> Subject:
    """Read what `write_subject` wrote."""
    members = {
        "name": TEXT,
        "head_model": TEXT,
        "shape": Member("f", ("S",), MAX_MAGNITUDE, "f4"),
        "static_offset": Member("f", ("V", 3), MAX_MAGNITUDE, "f4"),
    }
    arrays = read_arrays(path, members, {"S": head.shape_basis.shape[2], "V": len(head.template)})
    name, version = str(arrays["name"]), str(arrays["head_model"])
    if version != head.version:
        raise InputError(path, "head_model", repr(head.version), repr(version)[:80])
    return Subject(name, version, arrays["shape"], arrays["static_offset"])


class ReadAvatar(NamedTuple, Generic[Content]):
    """Contents of an avatar's folder: file paths, head model, subject, and content of the avatar's file."""

    files: list[Path]
    head: HeadArrays
    subject: Subject
    content: Content


Tensors = dict[str, Tensor]


def read_stored(
    folder: Path,
    name: str,
    content_of: Callable[[Path, Tensors, Mapping[str, str], HeadArrays], Content],
    read_coded: Callable[[Path, HeadArrays], tuple[Subject, Tensors, Mapping[str, str]]],
) -> ReadAvatar[Content]:
    """Read the coded file of a folder if there is one, else the file ``name`` and the subject written by training.

    - ``content_of``: checks the tensors and the metadata of a file, and returns the content; its last argument is the head
      model.
    - ``read_coded``: subject, tensors and metadata of the coded file (`avatars.compact.layouts.read_coded`).
    """
    head, coded = read_shared_head(folder), folder / COMPACT_FILE
    if coded.exists():
        subject, tensors, metadata = read_coded(coded, head)
        return ReadAvatar([coded], head, subject, content_of(coded, tensors, metadata, head))
    files = [folder / name, folder / SUBJECT_FILE]
    content = content_of(files[0], *read_safetensors(files[0]), head)
    return ReadAvatar(files, head, read_subject(files[1], head), content)


def settings_text(config: Any, names: Sequence[str], optional: Sequence[str] = ()) -> str:
    """Settings of a method by name as JSON, for an avatar's file; those in ``optional`` only where they are not 0."""
    values = {name: getattr(config, name) for name in names}
    return json.dumps({name: value for name, value in values.items() if value or name not in optional})


def settings_of_text(
    kind: type[Content], names: Sequence[str], text: str, path: Path, key: str, optional: Sequence[str] = ()
) -> Content:
    """Parse a `settings_text` into a configuration of class ``kind``; ``path`` and ``key`` locate it in errors."""
    values = parse_json(text, path, key)
    if {*values, *optional} != {*names, *optional}:
        raise InputError(path, key, f"the settings {', '.join(names)}", repr(text)[:80])
    return build(kind, values, str(path))


class RefinedTracking:
    """Tracking refined in training, which replaces the tracked pose of a training timestep.

    It applies only to the signal from which it was refined: subject, timestep and all tracked values must be equal, so
    held-out and foreign signals are never changed.

    ``tracked``, ``refined``: arrays of `TRACKED` by name, (T, n) float32, rows in the order of ``timesteps``.
    """

    def __init__(
        self,
        subject: str,
        timesteps: np.ndarray,
        tracked: Mapping[str, FloatArray],
        refined: Mapping[str, FloatArray],
    ):
        self._subject, self._tracked, self._refined = subject, dict(tracked), dict(refined)
        self._timesteps = np.asarray(timesteps, dtype=np.int64)
        self._row = {int(timestep): row for row, timestep in enumerate(self._timesteps)}

    def __len__(self) -> int:
        return len(self._timesteps)

    def __call__(self, pose: HeadPose) -> HeadPose:
        """Return the pose to render for a driving pose."""
        row = self._row.get(-1 if pose.timestep is None else pose.timestep)
        if row is None or pose.timestep is None or pose.subject != self._subject:
            return pose
        for name in TRACKED:
            if not np.array_equal(np.asarray(getattr(pose, name), np.float32), self._tracked[name][row]):
                return pose
        return replace(pose, **{name: self._refined[name][row] for name in TRACKED})

    def save(self, path: Path) -> None:
        """Write as npz."""
        tracked = {f"tracked_{name}": self._tracked[name] for name in TRACKED}
        refined = {f"refined_{name}": self._refined[name] for name in TRACKED}
        write_arrays(path, {"subject": self._subject, "timesteps": self._timesteps, **tracked, **refined})

    @classmethod
    def read(cls, path: Path) -> RefinedTracking:
        """Read what `save` wrote."""
        members = {"subject": TEXT, "timesteps": Member("iu", ("T",))} | {
            f"{kind}_{name}": Member("f", ("T", _SIZES.get(name, f"size of {name}")), MAX_MAGNITUDE, "f4")
            for kind in ("tracked", "refined")
            for name in TRACKED
        }
        arrays = read_arrays(path, members)
        tracked, refined = (
            {name: arrays[f"{kind}_{name}"] for name in TRACKED} for kind in ("tracked", "refined")
        )
        return cls(str(arrays["subject"]), arrays["timesteps"], tracked, refined)


def run_digest(method: str, version: str, config: Any, clip: Clip, budget: Budget, seed: int) -> str:
    """Digest of everything that affects training."""
    return digest(method, version, deciding_settings(config), clip.fingerprint, budget, seed)


def is_finished(folder: Path, run: str) -> bool:
    """Whether this folder contains the finished avatar of this run."""
    path = folder / TRAINING_FILE
    if not path.exists():
        return False
    recorded = read_json(path).get("run")
    if recorded != run:
        expected = "the same method, clip, settings, budget and seed"
        remedy = "Use another output folder, or delete this one."
        raise InputError(path, "run", expected, "the avatar of another run", remedy)
    return True


def write_record(fit: Fit, summary: TrainingSummary, **more: Any) -> None:
    """Write the record of a run. It is the last file of a fit: its presence marks a complete avatar."""
    done: dict[str, Any] = {"iterations": summary.iterations, "planned_iterations": summary.planned}
    if fit.capacity is not None:
        done["capacity"] = fit.capacity
    if summary.losses:
        done["losses"] = [[at, float(f"{value:.4g}")] for at, value in thinned(summary.losses)]
    write_json(
        fit.out / TRAINING_FILE, {"run": fit.run, **done, "seconds": round(summary.seconds, 3), **more}
    )


def thinned(losses: Sequence[tuple[int, float]]) -> list[tuple[int, float]]:
    """Losses averaged over equal blocks: at most `RECORDED_LOSSES` pairs of a block's last iteration and its mean loss."""
    size = -(-len(losses) // RECORDED_LOSSES)
    groups = [losses[start : start + size] for start in range(0, len(losses), size)]
    return [(group[-1][0], sum(value for _, value in group) / len(group)) for group in groups]


def finish_fit(fit: Fit, summary: TrainingSummary, subject: Subject, head: HeadAsset, **more: Any) -> None:
    """Write the common files of trained avatars, the record last."""
    write_subject(fit.out / SUBJECT_FILE, subject)
    save_shared_head(fit.out, head)
    write_record(fit, summary, **more)
