"""Check of unions exported elsewhere, and joining for the paper's split.

GaussianAvatars' download holds, per subject, a ``UNION10`` folder and its sequence folders, FREE among them;
the union uses another test sequence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ...bench.contracts import Progress, no_progress
from ...bench.errors import InputError
from ...bench.specs import CommandResult
from ..ga import layout
from ..ga.transforms import FrameEntry, read_transforms, timesteps_of
from ..ga.validate import check_images, check_timesteps
from ..ga.writer import write_union
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
    """Summary of a union folder.

    Attributes
    ----------
    notes : tuple[str, ...]
        Unusual but readable properties.
    free : str
        The sequence folder of FREE beside it, or "".
    rejoined : str
        The written union with the paper's split, or "".
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
) -> CommandResult:
    """Check the union of each subject under ``root``; with ``rejoin`` also write those of the paper's split.

    Passes if every subject has one and all are complete.
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
    """Write the union of the paper's split beside the others: all sequences of a union, and FREE as the test.

    Returns the folder's name. Raises `InputError` if FREE does not exist.
    """
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
