"""``headbench track --with``: runs another tracker in the user's installation and converts its result to a capture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ...bench.contracts import Progress
from ...bench.errors import InputError
from ...bench.io.files import check_output_folder
from ...bench.specs import CommandResult
from ..head.refit.command import target_head
from ..head.refit.rewrite import link_or_copy
from ..monocular.clip import check_subject, subject_of
from ..tracker_files.command import ImportTrackingSettings, import_tracking
from ..video.decode import is_video, probe_video
from .programs import LOG, WorkingFolder, check_program, export_folder, run_steps

CAPTURE = "capture"
"""Folder of the capture, beside that of the program."""

if TYPE_CHECKING:
    from .settings import TrackSettings


def track_with_program(settings: TrackSettings, progress: Progress) -> CommandResult:
    """Run another tracker on the file of a video and convert its output to a capture.

    Its files are in a folder of its name in ``settings.out``, the capture beside it. A repeated call resumes after the last
    finished step. Raises `InputError` before anything runs, and `ProgramError` for a program that fails.
    """
    source, name = Path(settings.capture), settings.program
    if not is_video(source):
        raise InputError(source, "", f"the file of a video, for --with {name}", "something else")
    probe_video(source)
    if not settings.head:
        raise InputError("command line", "--head", "the FLAME model that the tracker uses", "none")
    target_head(settings.head, "--head")
    subject = settings.subject or subject_of(source)
    check_subject(subject, "--subject")
    if "." in subject:
        raise InputError(
            "command line", "--subject", "a name without dots, which the programs cut off", subject
        )
    check_output_folder(Path(settings.out))
    checkout = Path(settings.checkout).absolute()
    program, interpreter = check_program(name, checkout, settings.python)
    folder = Path(settings.out).absolute() / name
    folder.mkdir(parents=True, exist_ok=True)
    work = WorkingFolder(folder, folder / f"{subject}.mp4")
    link_or_copy(source.resolve(), work.video)
    run_steps(name, program, checkout, interpreter, work, progress)
    message = f"{name} has finished; its output is in {folder / LOG}."
    if name == "vhap":
        capture = export_folder(work)
        text = f"{message}\nThen: headbench lint {capture} --head {settings.head}\nCapture: {capture}"
        return CommandResult(text, {"capture": capture.as_posix()})
    (tracked,) = sorted(folder.glob(f"tracking/{subject}_nV1*"))[:1]
    given = ImportTrackingSettings(
        source=str(tracked),
        head=settings.head or "",
        out=str(folder.parent / CAPTURE),
        format=name,
        images=str(folder / "preprocessed" / subject / "cropped"),
        subject=subject,
        held_out_frames=settings.held_out_frames,
    )
    found = import_tracking(given, progress)
    return CommandResult(f"{message}\n{found.text}", found.data)
