"""Plan of the work for a subject, validated completely before anything is decoded."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from ...bench.contracts import Camera
from ...bench.errors import InputError
from ...bench.io.files import digest
from ..ga import layout
from ..head.arrays import HeadArrays
from ..head.loaders import OPEN, load_head
from ..head.procedural.versions import VERSIONS
from .names import (
    NOVEL_VIEW_CAMERA,
    PAPER_SEQUENCES,
    SEQUENCES,
    TEST_SEQUENCE,
    TONGUE_SEQUENCES,
    UNION10_SEQUENCES,
    PrepareSettings,
    union10_held_out,
)
from .recording import Correction, Participant, participant, read_calibration
from .sequence import RecordedSequence, read_sequence
from .tracking import TrackedSequence, find_tracked, read_tracked

CY: layout.CyConvention = "bottom"
"""Origin of the principal point in VHAP's exports."""

IMAGES_VERSION = 1
"""Increased when the same recording and settings give other images than before."""

_USUAL_HEAD = "flame2023"
_OTHER_HEADS = {"flame2020": "FLAME 2020", OPEN: "FLAME 2023 Open"}
"""Versions of FLAME that the published tracking was not made with."""
_FLAME_VERSIONS = (_USUAL_HEAD, "flame2023_no_jaw", *_OTHER_HEADS)


@dataclass(frozen=True, eq=False)
class SequenceJob:
    """One sequence to prepare."""

    recorded: RecordedSequence
    cameras: Sequence[Camera]
    """Cameras of the prepared images in index order, in the aligned world."""
    corrections: Mapping[str, Correction]
    """Colour correction by serial; empty for none."""
    stills: Mapping[str, Path]
    """Images of the empty set by serial, used to remove its light from soft edges; empty to skip this."""
    tracked: TrackedSequence | None
    """Parameters, or None if there are none yet."""
    folder: Path
    on_white: bool = False
    """Whether the frames are finished: on white, with corrected colours."""

    @property
    def count(self) -> int:
        """Number of timesteps."""
        return len(self.recorded.numbers)

    def image_path(self, timestep: int, index: int) -> Path:
        """File of an image."""
        return self.folder / "images" / f"{layout.frame_name(timestep, index)}.png"

    def mask_path(self, timestep: int, index: int) -> Path:
        """File of a mask."""
        return self.folder / "fg_masks" / f"{layout.frame_name(timestep, index)}.png"

    @cached_property
    def images_fingerprint(self) -> str:
        """Digest of the inputs of images and cameras: calibration, settings, and source files by name and size."""
        views = {
            serial: [(path.name, path.stat().st_size) for path in view.files]
            for serial, view in self.recorded.views.items()
        }
        corrections = {serial: repr(vars(c)["matrix"].tolist()) for serial, c in self.corrections.items()}
        stills = {serial: path.stat().st_size for serial, path in self.stills.items()}
        cameras = [[c.id, c.width, c.height, c.K.tolist(), c.world_to_camera.tolist()] for c in self.cameras]
        finished = ["on white"] if self.on_white else []
        return digest(
            IMAGES_VERSION, views, corrections, stills, cameras, list(self.recorded.numbers), *finished
        )

    def metadata_fingerprint(self, declaration: layout.Declaration) -> str:
        """Digest of the inputs of the metadata beside the images: parameters and declaration."""
        tracked = self.tracked
        arrays = {} if tracked is None else {**tracked.frames, **tracked.constant}
        return digest(*sorted(arrays), *(arrays[key] for key in sorted(arrays)), declaration)


@dataclass(frozen=True, eq=False)
class PreparationPlan:
    """One subject to prepare: its sequences, the held-out ones, and its head model, if any."""

    subject: str
    jobs: Sequence[SequenceJob]
    test: Sequence[str]
    head: HeadArrays | None
    head_model: str
    union: Path
    novel_views: Sequence[str] = (NOVEL_VIEW_CAMERA,)
    """Cameras held out for novel views."""

    def declaration(self, jobs: Sequence[SequenceJob], head_file: str) -> layout.Declaration:
        """``headbench.json`` for a folder with these sequences."""
        return layout.Declaration(
            subject=self.subject,
            head_model=self.head_model,
            head_file=head_file,
            cy=CY,
            sequences={job.folder.name: job.recorded.name for job in jobs},
        )


def plan_subject(settings: PrepareSettings, subject: str) -> PreparationPlan:
    """Read everything about one subject except its pixels."""
    one = participant(Path(settings.root), subject)
    out = Path(os.path.abspath(settings.out))
    calibration = read_calibration(one.calibration_file)
    aligned = calibration.aligned()
    head = load_head(settings.head) if settings.head else None
    version = _head_version(settings, head)
    cameras = tuple(part.strip() for part in settings.cameras.split(",") if part.strip())
    wanted, test = wanted_sequences(settings, one)
    jobs = []
    for name in wanted:
        recorded = read_sequence(
            one,
            calibration,
            name,
            cameras=cameras,
            source=settings.source,
            every=settings.every or None,
            cut=settings.cut,
        )
        sizes = {view.size for view in recorded.views.values()}
        if len(sizes) > 1:
            found = ", ".join(f"{width}x{height}" for width, height in sorted(sizes))
            raise InputError(recorded.folder, "size", "cameras of one image size", found)
        size = sizes.pop()
        full = calibration.size or size
        small = full[0] // settings.downscale, full[1] // settings.downscale
        if min(small) < 1 or small[0] > size[0] or small[1] > size[1]:
            expected = f"a factor that makes images smaller than {size[0]}x{size[1]}"
            raise InputError("command line", "downscale", expected, f"{settings.downscale}")
        serials, masks = [*recorded.views], recorded.has_masks
        # Of all cameras in use, or none.
        stills = {serial: one.backgrounds[serial] for serial in serials if serial in one.backgrounds}
        unblend = settings.edges == "unblend" and masks and len(stills) == len(serials)
        label = f"v{len(serials)}_DS{settings.downscale}"
        jobs.append(
            SequenceJob(
                recorded=recorded,
                cameras=[aligned.camera(serial, size, small) for serial in serials],
                corrections=one.corrections(name, serials) if settings.colour == "auto" else {},
                stills=stills if unblend else {},
                tracked=_tracked(settings, recorded, head),
                folder=out / f"{subject}_{name}_{label}{'_whiteBg' if masks else ''}",
            )
        )
    label = f"v{len(jobs[0].cameras)}_DS{settings.downscale}"
    union = out / f"UNION{len(jobs)}_{subject}_{label}_{settings.split}-test"
    return PreparationPlan(subject, jobs, test, head, version, union)


def shortened(plan: PreparationPlan, timesteps: int, out: Path) -> PreparationPlan:
    """The first timesteps of one training sequence and of the held-out ones, in another folder: a sample to time."""
    trained = next(job for job in plan.jobs if job.recorded.name not in plan.test)
    jobs = []
    for job in (trained, *(job for job in plan.jobs if job.recorded.name in plan.test)):
        recorded, tracked = job.recorded, job.tracked
        numbers = recorded.numbers[:timesteps]
        if tracked is not None:
            frames = {key: values[:timesteps] for key, values in tracked.frames.items()}
            tracked = replace(tracked, frames=frames)
        recorded = replace(recorded, numbers=numbers, uncut=numbers)
        jobs.append(replace(job, recorded=recorded, tracked=tracked, folder=out / job.folder.name))
    return replace(plan, jobs=jobs, union=out / plan.union.name)


def _head_version(settings: PrepareSettings, head: HeadArrays | None) -> str:
    """Declared head model version of a capture: that of the given head model, or else a known name."""
    stated = settings.head_model
    if head is not None:
        if stated not in ("", head.version):
            expected = f"{head.version!r}, the version of {settings.head}"
            raise InputError("command line", "--head-model", expected, repr(stated), "Leave it out.")
        if head.version in _OTHER_HEADS and not stated:
            remedy = f"{settings.head} is {_OTHER_HEADS[head.version]}: say so if the tracking was made with it, else give FLAME 2023."
            raise InputError("command line", "--head-model", repr(head.version), "nothing", remedy)
        return head.version
    versions = (*_FLAME_VERSIONS, *VERSIONS)
    if stated and stated not in versions:
        expected = f"one of {', '.join(versions)}"
        remedy = "Give the file of another head model with --head."
        raise InputError("command line", "--head-model", expected, repr(stated), remedy)
    return stated or _USUAL_HEAD


def wanted_sequences(settings: PrepareSettings, one: Participant) -> tuple[list[str], list[str]]:
    """Full names of the sequences to prepare, and of those among them that are held out."""
    if settings.sequences == "paper":
        names = [*(PAPER_SEQUENCES if settings.split == "free" else UNION10_SEQUENCES)]
    elif settings.sequences == "all":
        left_out = (*TONGUE_SEQUENCES, "GLASSES")
        names = [name for name in SEQUENCES if name in one.sequences and name not in left_out]
    else:
        names = [part.strip() for part in settings.sequences.split(",") if part.strip()]
    matched = list(dict.fromkeys(one.match(name) for name in names))
    held_out = TEST_SEQUENCE if settings.split == "free" else union10_held_out(one.subject)
    if not set(matched) - {held_out}:
        found = ", ".join(matched) or "none"
        raise InputError("command line", "sequences", "at least one sequence to train on", found)
    return matched, [name for name in matched if name == held_out]


def _tracked(
    settings: PrepareSettings, recorded: RecordedSequence, head: HeadArrays | None
) -> TrackedSequence | None:
    if not settings.tracking:
        return None
    root = Path(settings.tracking)
    if not root.is_dir():
        raise InputError(root, "", "a folder with VHAP's results", "a file" if root.exists() else "nothing")
    file = find_tracked(root, recorded.subject, recorded.name)
    if file is None:
        return None
    numbers = set(recorded.numbers)
    kept = [number in numbers for number in recorded.uncut]
    return read_tracked(file, timesteps=len(numbers), head=head, kept=kept)
