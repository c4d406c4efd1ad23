"""Tracked FLAME parameters of VHAP, found by subject and sequence, and validated.

Check of unions exported elsewhere, and joining for the paper's split. GaussianAvatars' download holds, per subject, a
``UNION10`` folder and its sequence folders, FREE among them; the union uses another test sequence.

Formats read:

- VHAP's `tracked_flame_params_*.npz`. Written by ShenhanQian/VHAP@4b64ab7d (`vhap/model/tracker.py`). Not checked on a file of the program.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...bench.contracts import FloatArray, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.arrays import MAX_MAGNITUDE, check_numbers, read_npz
from ...bench.specs import CommandResult
from ..ga import layout
from ..ga.layout import parse_sequence_folder
from ..ga.tracking import POSE_SIZES, resolve_teeth
from ..ga.transforms import FrameEntry, read_transforms, timesteps_of
from ..ga.validate import check_images, check_timesteps
from ..ga.writer import CANONICAL_JAW, write_union
from ..head.arrays import HeadArrays
from .names import (
    FRONTAL_INDEX,
    NOVEL_VIEW_CAMERA,
    TEST_SEQUENCE,
    UNION10_SEQUENCES,
    match_sequence,
    union10_held_out,
)


@dataclass(frozen=True)
class UnionReport:
    """Summary of a union folder."""

    subject: str
    folder: str = ""
    train: tuple[str, ...] = ()
    test: tuple[str, ...] = ()
    timesteps: int = 0
    cameras: int = 0
    fault: str = ""
    notes: tuple[str, ...] = ()
    """Unusual but readable properties."""
    free: str = ""
    """The sequence folder of FREE beside it, or ""."""
    rejoined: str = ""
    """The written union with the paper's split, or ""."""


def check_unions(
    root: Path, subjects: Sequence[str], *, rejoin: bool = False, progress: Progress = no_progress
) -> CommandResult:
    """Check the union of each subject under ``root``; with ``rejoin`` also write those of the paper's split. Passes if
    every subject has one and all are complete."""
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
    return CommandResult("\n".join(lines), {report.subject: vars(report) for report in reports}, passed)


def _report(root: Path, subject: str, rejoin: bool) -> UnionReport:
    try:
        folder = _find(root.resolve(), subject)
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
    """The subject's union, except one of the paper's split written by headbench."""
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
    # Older exports name cameras only by index.
    indices = {entry.camera_index for entry in entries["novel_view"]}
    if views and NOVEL_VIEW_CAMERA not in views and indices != {FRONTAL_INDEX}:
        notes.append(f"novel views are of {', '.join(sorted(views))}, not of the frontal {NOVEL_VIEW_CAMERA}")
    if not views:
        notes.append("no novel views")
    return notes


_REJOINED = "_rejoined"


def rejoin_union(root: Path, subject: str, entries: Sequence[FrameEntry], free: str) -> str:
    """Write the union of the paper's split beside the others: all sequences of a union, and FREE as the test. Returns
    the folder's name. Raises `InputError` if FREE does not exist."""
    if not free:
        expected = f"a sequence folder {subject}_{TEST_SEQUENCE}_..., exported with its parameters"
        raise InputError(root, subject, expected, "none")
    folders = dict.fromkeys(entry.sequence_folder for entry in entries)
    named = {layout.parse_sequence_folder(folder)[1]: folder for folder in folders if folder != free}
    order = {match_sequence(root, name, UNION10_SEQUENCES): folder for name, folder in named.items()}
    train = [root / order[name] for name in UNION10_SEQUENCES if name in order]
    union = root / f"UNION{len(train) + 1}_{subject}{_REJOINED}"
    # The frontal camera by its serial, else by the index that VHAP holds out.
    ids = {entry.camera_id for entry in entries}
    by_index = sorted({entry.camera_id for entry in entries if entry.camera_index == FRONTAL_INDEX})
    held_out = [NOVEL_VIEW_CAMERA] if NOVEL_VIEW_CAMERA in ids else by_index
    write_union(union, train, [root / free], held_out, None)
    return union.name


_RESULT = re.compile(r"tracked_flame_params_(\d+)\.npz")


@dataclass(frozen=True, eq=False)
class TrackedSequence:
    """Parameters of T timesteps, in the aligned world."""

    file: Path
    """Source of the values."""
    frames: Mapping[str, FloatArray]
    """Arrays with T rows: those of `POSE_SIZES`, ``expr``, and ``dynamic_offset`` and ``eyelids`` if present."""
    constant: Mapping[str, FloatArray]
    """``shape`` (S,) and ``static_offset`` (1, V, 3), zeros if the tracker wrote none."""

    @property
    def count(self) -> int:
        """Number of timesteps."""
        return len(self.frames["translation"])

    @property
    def shift(self) -> FloatArray:
        """(3,) mean translation, which an export subtracts from the poses and from the cameras."""
        mean: FloatArray = self.frames["translation"].astype(np.float64).mean(axis=0)
        return mean

    def parameters(self, timestep: int) -> dict[str, FloatArray]:
        """One ``flame_param`` file, float32, in the shifted world."""
        rows = {key: values[timestep : timestep + 1] for key, values in self.frames.items()}
        moved = rows["translation"].astype(np.float64) - self.shift
        return {**rows, "translation": moved.astype(np.float32), **self.constant}

    def canonical(self) -> dict[str, FloatArray]:
        """``canonical_flame_param.npz``: zeros except for identity, static offset and an open jaw (float64)."""
        zeros = {
            key: np.zeros_like(values[:1]) for key, values in self.frames.items() if key != "dynamic_offset"
        }
        return {**zeros, "jaw_pose": np.array([CANONICAL_JAW], dtype=np.float64), **self.constant}


def read_tracked(
    path: Path, *, timesteps: int, head: HeadArrays | None = None, kept: Sequence[bool] = ()
) -> TrackedSequence:
    """Read ``tracked_flame_params_*.npz`` and check it against the frames and, where given, the head model. ``kept`` is
    whether each frame before a cut is among the ``timesteps``; parameters of all frames are cut accordingly."""
    arrays = read_npz(path)
    if "rotation_matrices" in arrays:
        remedy = (
            "The benchmark's tracking has Euler angles about the model's origin; run VHAP on the recording."
        )
        raise InputError(path, "rotation_matrices", "VHAP's arrays", "the benchmark's tracking", remedy)
    if len(kept) > timesteps:
        arrays = _cut(path, arrays, timesteps, np.asarray(kept, dtype=bool))
    frames = {key: _floats(path, arrays, key, (timesteps, size)) for key, size in POSE_SIZES.items()}
    frames["expr"] = _floats(path, arrays, "expr", (timesteps, None))
    for key, shape in (("dynamic_offset", (timesteps, None, 3)), ("eyelids", (timesteps, 2))):
        if key in arrays:
            frames[key] = _floats(path, arrays, key, shape)
    identity = _floats(path, arrays, "shape", (None,))
    offset = _floats(path, arrays, "static_offset", (1, None, 3)) if "static_offset" in arrays else None
    if head is not None:
        _check_head(path, head, len(identity), frames["expr"].shape[1], offset)
    rows = offset if offset is not None else np.zeros((1, _rows(path, frames, head), 3), np.float32)
    return TrackedSequence(path, frames, {"shape": identity, "static_offset": rows})


def find_tracked(root: Path, subject: str, sequence: str) -> Path | None:
    """Final parameters of a sequence under VHAP's output folder; None if there are none.

    Looks in folders named as VHAP's scripts name them (``074_EMO-1_v16_DS4_wBg_staticOffset``) or plainly
    ``074_EMO-1-shout+laugh``, uses the latest dated run inside, and its last epoch.
    """
    folders = sorted(path for path in root.iterdir() if path.is_dir()) if root.is_dir() else []
    fitting = []
    for folder in folders:
        who, what = parse_sequence_folder(folder.name)
        if who == subject and (sequence == what or sequence.startswith(f"{what}-")) and [*_results(folder)]:
            fitting.append(folder)
    if len(fitting) > 1:
        found = ", ".join(folder.name for folder in fitting)
        raise InputError(root, f"{subject} {sequence}", "one folder of tracked parameters", found)
    return max(_results(fitting[0]))[2] if fitting else None


def _results(folder: Path) -> Iterator[tuple[str, int, Path]]:
    """Run, epoch and file of each result, in the folder or in the dated folders below."""
    for path in (*folder.glob("*.npz"), *folder.glob("*/*.npz")):
        if match := _RESULT.fullmatch(path.name):
            yield (path.parent.name if path.parent != folder else "", int(match[1]), path)


def _cut(
    path: Path, arrays: dict[str, np.ndarray], timesteps: int, kept: np.ndarray
) -> dict[str, np.ndarray]:
    """The arrays with only the rows of kept frames, if they have rows for all frames."""
    rows = arrays["translation"].shape[:1] if "translation" in arrays else ()
    if rows == (len(kept),):
        moving = {*POSE_SIZES, "expr", "dynamic_offset", "eyelids"}
        return {
            key: array[kept] if key in moving and array.shape[:1] == rows else array
            for key, array in arrays.items()
        }
    if rows and rows != (timesteps,):
        raise InputError(
            path,
            "translation",
            f"{timesteps} timesteps, as the frames kept, or {len(kept)}, as before --cut",
            f"{rows[0]}",
            "Name the cameras that have all frames with --cameras, mind --every, or prepare the images without "
            "--tracking and track these frames.",
        )
    return arrays


def _floats(
    path: Path, arrays: Mapping[str, np.ndarray], key: str, shape: tuple[int | None, ...]
) -> FloatArray:
    """An array as float32; None in ``shape`` fits any size."""
    if key not in arrays:
        expected = "an array"
        raise InputError(path, key, expected, f"only {', '.join(sorted(arrays))}", "Give VHAP's own output.")
    array = arrays[key]
    if key == "shape" and array.ndim == 2 and len(array) == 1:
        array = array[0]
    wanted = tuple("any" if size is None else size for size in shape)
    fits = array.ndim == len(shape) and all(s in (None, n) for s, n in zip(shape, array.shape))
    if not fits or array.dtype.kind not in "fiu":
        remedy = ""
        if array.ndim and shape[0] is not None and array.shape[0] != shape[0]:
            remedy = "Track the very frames that are prepared (mind every, and the frames VHAP extracted)."
        raise InputError(path, key, f"numbers of shape {wanted}", f"{array.dtype} {array.shape}", remedy)
    with np.errstate(over="ignore"):  # overflow gives infinity, which is refused
        values = array.astype(np.float32)
    check_numbers(path, key, values, MAX_MAGNITUDE)
    return values


def _check_head(
    path: Path, head: HeadArrays, identities: int, expressions: int, offset: FloatArray | None
) -> None:
    remedy = "Give the head model the sequence was tracked with."
    sizes = (
        ("shape", identities, head.shape_basis.shape[2]),
        ("expr", expressions, head.expression_basis.shape[2]),
    )
    for key, found, most in sizes:
        if found > most:
            expected = f"at most {most} coefficients, as head model {head.version} has"
            raise InputError(path, key, expected, f"{found}", remedy)
    resolve_teeth(head, None if offset is None else offset.shape[1], "auto", path)


def _rows(path: Path, frames: Mapping[str, FloatArray], head: HeadArrays | None) -> int:
    """Number of vertices of the tracked mesh, for a static offset of zeros, which GaussianAvatars requires."""
    if "dynamic_offset" in frames:
        return frames["dynamic_offset"].shape[1]
    if head is not None:
        return len(resolve_teeth(head, None, "auto", path)[0].template)
    remedy = "Give the head model, so that zeros of its size can be written."
    raise InputError(path, "static_offset", "an array", "none", remedy)
