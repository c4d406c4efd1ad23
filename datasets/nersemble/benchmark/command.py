"""``headbench prepare benchmark``, ``submission write`` and ``submission check``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from ....bench.contracts import Progress, no_progress
from ....bench.errors import ExitCode, InputError, UnavailableError
from ....bench.specs import CommandResult, command
from ..names import chosen_subjects

SHOWN = 20


@dataclass(frozen=True)
class BenchmarkPrepareSettings:
    """Convert the training data of the NeRSemble benchmark to captures: all training sequences and cameras, images on white
    as they are, masks, and the tracking of the monocular track."""

    data: tyro.conf.Positional[str]
    """The benchmark's folder, as nersemble-benchmark-download leaves it: it holds mono_flame_avatar/ or nvs/."""

    head: str
    """FLAME 2023 (flame2023.pkl), which the tracking belongs to. It is not copied."""

    out: str
    """Folder for the captures."""

    track: Literal["nvs", "mono_flame_avatar"] = "mono_flame_avatar"
    """Task of the benchmark. Captures of nvs have no tracking: their poses are zero, for `headbench track`."""

    participants: str = ""
    """Participants separated by commas; default: all that were downloaded."""

    test: tuple[str, ...] = ()
    """Training sequences that are held out, as the benchmark's own test frames are not public; default: none, so that
    methods are trained on everything, and no frames are measured."""

    every: int = 1
    """Keep the frames whose number this divides; of nvs, which has 73 frames a second, the default are all."""

    workers: int = 0
    """Number of cameras processed at a time; 0 stands for one per processor core."""


@command("prepare benchmark", group="data", writes="out", kinds=("captures",))
def prepare_benchmark(settings: BenchmarkPrepareSettings, progress: Progress = no_progress) -> CommandResult:
    """Convert the training data of the NeRSemble benchmark to captures."""
    from ...head.loaders import load_head
    from ..prepare import prepare  # imports torch
    from ..recording import participant, participants
    from .prepare import plan_participant
    from .submission import MONO, TRACKS

    data, track, out = Path(settings.data), TRACKS[settings.track], Path(settings.out)
    root = data / track.name
    for key, least in (("every", 1), ("workers", 0)):
        if (value := getattr(settings, key)) < least:
            raise InputError("command line", f"--{key}", f"a number from {least}", f"{value}")
    if not root.is_dir():
        remedy = f"Name the folder that holds {track.name}/, or download it: nersemble-benchmark-download FOLDER {track.name}."
        raise InputError(
            root, "", "a folder of the benchmark", "a file" if root.exists() else "nothing", remedy
        )
    subjects = (
        chosen_subjects(settings.participants, "--participants")
        if settings.participants
        else [*participants(root)]
    )
    head = load_head(settings.head)
    plans = [
        plan_participant(data, track, participant(root, subject), head, out, settings.test, settings.every)
        for subject in subjects
    ]
    results = prepare(plans, workers=settings.workers, progress=progress)
    lines = []
    for result in results:
        splits = ", ".join(f"{count} {name}" for name, count in result.frames.items() if count)
        lines += [
            f"{result.subject}: {result.written} images written, {result.kept} there already: {splits}."
        ]
        given = f"--head {settings.head}"
        if track is MONO:
            use = f"headbench run --data {result.union} {given} --out runs/{result.subject}"
        else:
            use = f"headbench track {result.union} {given} --out {settings.out}-tracked"
        lines += [f"  Use it: {use}"]
    return CommandResult("\n".join(lines), {result.subject: str(result.union) for result in results})


@command("submission write", group="export")
def submission_write(
    frames: tyro.conf.Positional[str],
    zip: tyro.conf.Positional[str],
    track: Literal["nvs", "mono_flame_avatar"],
    method: str = "",
    data: str | None = None,
    progress: Progress = no_progress,
) -> CommandResult:
    """Write a submission to the NeRSemble benchmark; exit code 3 without ffmpeg.

    Videos are H.264 of constant rate factor 14, YUV 4:2:0, as the benchmark's documentation says. The cost is measured on
    the encoded frames themselves.

    Parameters
    ----------
    frames : str
        Folder with PARTICIPANT/SEQUENCE_TIMESTEP_SERIAL.png, or a run whose subjects are the participants.
    zip : str
        File to write.
    track : str
        Task of the benchmark.
    method : str
        Method of a run with several.
    data : str | None
        The benchmark's folder, whose tracking has the number of frames of each sequence. Without it, the published totals are checked.
    """
    from .submission import TRACKS, after_encoding, decibels, find_frames, write_submission

    task, out = TRACKS[track], Path(zip)
    files = find_frames(Path(frames), task, method, None if data is None else Path(data))
    try:
        encoded = write_submission(files, task, out, progress)
    except UnavailableError as error:
        return CommandResult(str(error), {"error": str(error)}, False, ExitCode.NO_VERDICT)
    lines = [f"{'video':<56}{'frames':>7}{'MB':>8}{'dB to frames':>14}"]
    lines += [
        f"{e.video.name:<56}{e.frames:>7}{e.size / 1e6:>8.2f}{decibels(e.error):>14.2f}" for e in encoded
    ]
    mean = sum(e.error for e in encoded) / len(encoded)
    costs = {psnr: psnr - after_encoding(psnr, mean) for psnr in (20.0, 25.0, 30.0, 35.0, 40.0)}
    lines.append(
        f"The codec costs renders of {', '.join(f'{psnr:g}' for psnr in costs)} dB "
        f"{', '.join(f'{cost:.2f}' for cost in costs.values())} dB of PSNR."
    )
    lines.append(
        f"{out}: {len(encoded)} videos, {out.stat().st_size / 1e6:.1f} MB; check it: headbench submission check"
    )
    videos = [
        {**e._asdict(), "video": e.video.name, "psnr": decibels(e.error) if e.error else None}
        for e in encoded
    ]
    data_out = {"out": out, "videos": videos, "cost_db": {str(psnr): cost for psnr, cost in costs.items()}}
    return CommandResult("\n".join(lines), data_out)


@command("submission check", group="export")
def submission_check(
    zip: tyro.conf.Positional[str],
    track: Literal["", "nvs", "mono_flame_avatar"] = "",
    data: str | None = None,
    progress: Progress = no_progress,
) -> CommandResult:
    """Check a submission to the NeRSemble benchmark as its server does.

    Exit code 0: no fault; 1: a fault; 2: not a readable zip.

    Parameters
    ----------
    zip : str
        The submission.
    track : str
        Task of the benchmark; default: the one that the zip has most files of.
    data : str | None
        The benchmark's folder, whose tracking has the number of frames of each sequence. Without it, the published totals are checked.
    """
    from .submission import check_submission

    task, issues = check_submission(Path(zip), None if data is None else Path(data), track, progress)
    lines = [f"{zip}: track {task.name}"]
    for title, found in (("Would be refused", issues.refused), ("Worth a look", issues.noted)):
        if found:
            lines += [f"{title}:", *(f"  {line}" for line in found[:SHOWN])]
            lines += [f"  and {len(found) - SHOWN} more"] if len(found) > SHOWN else []
    if not issues.refused:
        lines.append("Nothing that the server would refuse.")
    data_out = {"track": task.name, "refused": issues.refused, "noted": issues.noted}
    return CommandResult("\n".join(lines), data_out, not issues.refused)
