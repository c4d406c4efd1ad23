"""``headbench prepare nersemble`` and ``headbench record nersemble``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from ...bench.contracts import Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.files import check_kind
from ...bench.options import DependentOptions
from ...bench.specs import Findings, writes
from ..ga.layout import HEAD_FILE
from ..head.arrays import save_head
from ..options import CaptureOptions
from .names import SUBJECT_NAMES, chosen_subjects

if TYPE_CHECKING:
    from .plan import PreparationPlan
    from .prepare import SubjectResult


@dataclass(frozen=True)
class PrepareSettings:
    """What to prepare, from where, and how."""

    root: str = ""
    """Folder with raw recordings: the one that holds the participants' folders."""
    out: str = "nersemble-captures"
    """Folder for the captures."""
    subjects: str = "paper"
    """Ids separated by commas, "paper" (the nine of the comparison) or "ablation" (306)."""
    sequences: str = "paper"
    """Names or unique prefixes separated by commas; "paper" (the ten of UNION10, and FREE); "all" (but the tongue
    and GLASSES)."""
    split: Literal["free", "union10"] = "free"
    """"free" holds out FREE for self-reenactment; "union10" holds out one of the ten sequences by VHAP's seeded
    rule. The frontal camera is held out for novel views either way."""
    tracking: str = ""
    """Folder with VHAP's results. Without it images and cameras are written; call again once there is one."""
    head: str = ""
    """Head model the tracking belongs to (flame2023.pkl, or npz): checked against it, never copied if FLAME's."""
    head_model: str = ""
    """Version of the head model the tracking belongs to; default: that of --head, or flame2023 without --head."""
    cameras: str = ""
    """Serials separated by commas; default: all the calibration has."""
    downscale: int = 4
    """Width and height are divided by this, averaging areas; 4 makes 550x802 of 2200x3208."""
    source: Literal["auto", "video", "images"] = "auto"
    """What to take where a sequence has both; "auto" takes images where they come with masks."""
    every: int = 0
    """Frame stride; 0 stands for 3 with the 73-per-second videos and 1 with VHAP's images."""
    colour: Literal["auto", "none"] = "auto"
    """"auto" corrects colours where the recording has a calibration for that; "none" never."""
    edges: Literal["unblend", "plain"] = "unblend"
    """Soft edges with masks: "unblend" takes the light of the BACKGROUND still out, where there are stills; "plain"
    multiplies by the mask, as VHAP does, and leaves fringes."""
    cut: bool = False
    """Keep the frames that all cameras have where they differ, instead of an error; tracking of all frames is cut
    with them."""
    workers: int = 0
    """Number of cameras processed at a time; 0 stands for one per processor core."""
    check: bool = False
    """Only look whether everything needed is there."""
    union_root: str = ""
    """Instead of preparing, check captures exported elsewhere: a folder of UNION folders, such as GaussianAvatars'
    download. Of the other options only --subjects and --rejoin go with it."""
    rejoin: bool = False
    """With --union-root, also write unions of the paper's split (FREE held out) beside them; copies nothing."""

    dependent = (
        DependentOptions(
            (
                *(
                    "out",
                    "sequences",
                    "split",
                    "tracking",
                    "head",
                    "head_model",
                    "cameras",
                    "downscale",
                    "source",
                ),
                *("every", "colour", "edges", "cut", "workers", "check"),
            ),
            "union_root",
            False,
        ),
        DependentOptions(("rejoin",), "union_root"),
    )


@dataclass(frozen=True)
class RecordSettings(CaptureOptions):
    """What to write as a raw recording."""

    capture: tyro.conf.Positional[str]
    """Synthetic capture: a UNION folder, as `headbench synth` writes them."""
    out: str
    """Folder to write: recording/ is for --root of `headbench prepare nersemble`, tracking/ for --tracking,
    head_model.npz for --head."""
    release: Literal["v2", "v1", "paper2023"] = "v2"
    """Whose folders: of the second release, of the first, or of the 2023 paper."""
    frames: Literal["images", "video"] = "images"
    """"images" with masks, as VHAP's preprocessing leaves them, or "video" without."""


def prepare_nersemble(settings: PrepareSettings, progress: Progress = no_progress) -> Findings:
    """Convert raw NeRSemble recordings to captures; an interrupted conversion is continued.

    Everything about every subject is checked before the first frame is decoded.
    """
    from .export import check_unions
    from .plan import plan_subject
    from .prepare import prepare

    subjects = chosen_subjects(settings.subjects)
    if bool(settings.root) == bool(settings.union_root):
        found = "both" if settings.root else "neither"
        raise InputError("command line", "--root", "--root or --union-root", found)
    if settings.downscale < 1:
        raise InputError("command line", "--downscale", "a number from 1", f"{settings.downscale}")
    for key in ("every", "workers"):
        if getattr(settings, key) < 0:
            raise InputError("command line", f"--{key}", "a number from 0", f"{getattr(settings, key)}")
    if settings.union_root:
        return check_unions(Path(settings.union_root), subjects, rejoin=settings.rejoin, progress=progress)
    check_kind(Path(settings.out), "captures")
    _check_named(settings, subjects)
    plans = [plan_subject(settings, subject) for subject in subjects]
    if settings.check:
        return _checked(plans)
    return _done(prepare(plans, workers=settings.workers, progress=progress), plans, settings)


def _check_named(settings: PrepareSettings, subjects: list[str]) -> None:
    """Raise `InputError` where a name stands for subjects of which none is there."""
    from .recording import participants

    known = participants(Path(settings.root))
    if settings.subjects not in SUBJECT_NAMES or set(subjects) & set(known):
        return
    remedy = f"Name those to prepare, as in --subjects {next(iter(known))}"
    remedy += ': it defaults to "paper".' if settings.subjects == "paper" else "."
    expected = f'folders of "{settings.subjects}", which is {", ".join(subjects)}'
    raise InputError(settings.root, "--subjects", expected, ", ".join(known), remedy)


def _table(plans: list[PreparationPlan]) -> list[str]:
    lines = [f"{'subject':8} {'sequence':34} {'timesteps':>9} {'cameras':>7}  masks  colour  tracking"]
    for plan in plans:
        for job in plan.jobs:
            test = " (test)" if job.recorded.name in plan.test else ""
            marks = (job.recorded.has_masks, bool(job.corrections), job.tracked is not None)
            flags = "  ".join(f"{'yes' if mark else 'no':6}" for mark in marks)
            lines.append(
                f"{plan.subject:8} {job.recorded.name + test:34} {job.count:9} {len(job.cameras):7}  {flags}"
            )
    return lines


def _checked(plans: list[PreparationPlan]) -> Findings:
    images = sum(job.count * len(job.cameras) for plan in plans for job in plan.jobs)
    text = "\n".join([*_table(plans), "", f"All there: {images} images to make."])
    return Findings(text, {"images": images, "subjects": [plan.subject for plan in plans]})


def _done(results: list[SubjectResult], plans: list[PreparationPlan], settings: PrepareSettings) -> Findings:
    """Passed unless parameters were asked for and are missing."""
    lines = _table(plans)
    for plan, result in zip(plans, results, strict=True):
        lines += ["", f"{result.subject}: {result.written} images written, {result.kept} there already."]
        lines += [f"  {sentence}" for sentence in result.missing]
        if result.union is not None:
            splits = ", ".join(f"{count} {name}" for name, count in result.frames.items())
            suffix = "pkl" if plan.head_model.startswith("flame") else "npz"
            head = f" --head {settings.head or f'{plan.head_model}.{suffix}'}"
            lines += [
                f"  Frames: {splits}.",
                f"  Use it: headbench run --data {result.union}{head} --out runs/{result.subject}",
            ]
    data = {}
    for result in results:
        data[result.subject] = {**vars(result), "missing": list(result.missing)}
        del data[result.subject]["subject"]
    passed = not settings.tracking or all(result.union is not None for result in results)
    return Findings("\n".join(lines), data, passed)


@writes("out", "a recording")
def record_nersemble(settings: RecordSettings, progress: Progress = no_progress) -> Findings:
    """Write a synthetic capture as a raw NeRSemble recording with VHAP's tracking, to test `prepare`.

    For synthetic captures, as they bring their own head model.
    """
    from ...bench.io.video import video_codec
    from ..clip import check_apart
    from .re_record import re_record

    clip = settings.open(settings.capture, progress)
    out = Path(settings.out)
    check_apart(clip, out)
    masks = settings.frames == "images"
    sequences = re_record(
        clip,
        out / "recording",
        tracking=out / "tracking",
        release=settings.release,
        masks=masks,
        source=settings.capture,
        progress=progress,
    )
    save_head(out / HEAD_FILE, clip.head)
    codec = "" if masks or settings.release == "paper2023" else video_codec()
    text = (
        f"Subject {clip.subject}, {len(sequences)} sequences, {len(clip.cameras)} cameras"
        f"{f', videos in {codec}' if codec else ''}.\n"
        f"Prepare it: headbench prepare nersemble --root {out / 'recording'} --tracking {out / 'tracking'} "
        f"--head {out / HEAD_FILE} --subjects {clip.subject} --sequences {','.join(sequences)} --downscale 1"
    )
    data = {"subject": clip.subject, "sequences": sequences, "cameras": [*clip.cameras], "codec": codec}
    return Findings(text, data)
