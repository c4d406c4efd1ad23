"""Trackers of other authors, run in the user's own installation on the file of a video.

Requirements of the trackers of other authors on the machine, for ``headbench doctor``. ``headbench track --with``: runs
another tracker in the user's installation and converts its result to a capture.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...bench.configuration import build
from ...bench.contracts import Progress
from ...bench.errors import InputError
from ...bench.io.documents import read_json
from ...bench.io.files import check_output_folder, digest, digest_file, write_json
from ...bench.io.videos import is_video, probe_video
from ...bench.process import described, environment, run_program
from ...bench.specs import CommandResult, Need
from ..ga.writer import link_or_copy
from ..head.refit.command import target_head
from ..monocular.clip import check_subject, subject_of
from ..tracker_files.command import ImportTrackingSettings, import_tracking

IMPORT_TIMEOUT_S = 300.0
"""Time limit for an interpreter to import the modules of a program, seconds."""
STEPS, LOG = "steps.json", "program.log"


@dataclass(frozen=True)
class WorkingFolder:
    """Working folder of a program."""

    folder: Path
    """For everything that the program writes; absolute."""
    video: Path
    """The file of the video in it, named by the subject."""

    @property
    def name(self) -> str:
        """Name of the video, by which the programs name their folders."""
        return self.video.stem


@dataclass(frozen=True)
class Step:
    """One of a program's commands."""

    name: str
    """For messages."""
    arguments: Callable[[WorkingFolder], list[str]]
    """Arguments of the interpreter, in the checkout's folder: a script and its arguments."""
    output: str
    """Pattern of files in the working folder of which one exists afterwards; programs may fail with exit code 0. It
    contains ``{name}`` for the name of the video."""


@dataclass(frozen=True)
class TrackingProgram:
    """A tracker."""

    url: str
    commit: str
    """Its repository, and the commit that the commands are of."""
    steps: tuple[Step, ...]
    """In order."""
    variables: Callable[[Path, WorkingFolder], Mapping[str, str]]
    """Environment variables in addition to those of `run_program`, of checkout and work."""
    modules: tuple[str, ...]
    """Modules that its interpreter must be able to import."""
    files: tuple[str, ...]
    """Files of the checkout that it distributes separately, such as weights, with the remedy if one is missing."""
    remedy: str
    """How to get them."""


def _no_variables(checkout: Path, work: WorkingFolder) -> Mapping[str, str]:
    return {}


def _pixel3dmm_paths(checkout: Path, work: WorkingFolder) -> Mapping[str, str]:
    return {
        "PIXEL3DMM_CODE_BASE": str(checkout),
        "PIXEL3DMM_PREPROCESSED_DATA": str(work.folder / "preprocessed"),
        "PIXEL3DMM_TRACKING_OUTPUT": str(work.folder / "tracking"),
    }


def _predict(kind: str) -> Step:
    return Step(
        f"prediction of {kind}",
        lambda work: [
            "scripts/network_inference.py",
            f"model.prediction_type={kind}",
            f"video_name={work.name}",
        ],
        f"preprocessed/{{name}}/p3dmm/{kind}/*.png",
    )


VHAP = TrackingProgram(
    url="https://github.com/ShenhanQian/VHAP",
    commit="4b64ab7dc62232110fcdb47d6b5c55e832bc452d",
    steps=(
        Step(
            "frames and matting",
            lambda work: [
                *("vhap/preprocess_video.py", "--input", str(work.video)),
                *("--matting_method", "robust_video_matting"),
            ],
            "{name}/alpha_maps/*",
        ),
        Step(
            "tracking",
            lambda work: [
                *("vhap/track.py", "--data.root_folder", str(work.folder), "--data.sequence", work.name),
                *("--exp.output_folder", str(work.folder / "output")),
            ],
            "output/**/tracked_flame_params*.npz",
        ),
        Step(
            "export",
            lambda work: [
                *("vhap/export_as_nerf_dataset.py", "--src_folder", str(work.folder / "output")),
                *("--tgt_folder", str(export_folder(work)), "--background-color", "white"),
            ],
            "export/*/transforms*.json",
        ),
    ),
    variables=_no_variables,
    modules=("torch", "nvdiffrast", "tyro"),
    files=("asset/flame/flame2023.pkl", "asset/flame/FLAME_masks.pkl"),
    remedy="Put FLAME 2023 and its masks there, as the page of VHAP says.",
)

PIXEL3DMM = TrackingProgram(
    url="https://github.com/SimonGiebenhain/pixel3dmm",
    commit="98b5d79f18bc478282494be02f984dc93f5c9fe9",
    steps=(
        Step(
            "preprocessing",
            lambda work: ["scripts/run_preprocessing.py", "--video_or_images_path", str(work.video)],
            "preprocessed/{name}/seg_og/*",
        ),
        _predict("normals"),
        _predict("uv_map"),
        Step(
            "tracking",
            lambda work: ["scripts/track.py", f"video_name={work.name}"],
            "tracking/{name}_nV1*/checkpoint/*.frame",
        ),
    ),
    variables=_pixel3dmm_paths,
    modules=("torch", "nvdiffrast", "pixel3dmm"),
    files=("pretrained_weights/uv.ckpt", "pretrained_weights/normals.ckpt"),
    remedy="Run ./install_preprocessing_pipeline.sh in the checkout, which downloads them.",
)

PROGRAMS: Mapping[str, TrackingProgram] = {"vhap": VHAP, "pixel3dmm": PIXEL3DMM}


def export_folder(work: WorkingFolder) -> Path:
    """Folder of VHAP's export, named as its page names it."""
    return work.folder / "export" / f"{work.name}_whiteBg_staticOffset_maskBelowLine"


def check_program(name: str, checkout: Path, python: str) -> tuple[TrackingProgram, Path]:
    """The program of a name, whose checkout and interpreter are complete, and the interpreter's path."""
    check_checkout(name, checkout)
    return PROGRAMS[name], check_interpreter(name, python)


def check_checkout(name: str, checkout: Path) -> None:
    """Raise `InputError` for a script or a file of a program that is missing."""
    program = PROGRAMS[name]
    scripts = [step.arguments(WorkingFolder(Path("/"), Path("/video.mp4")))[0] for step in program.steps]
    for script in scripts:
        if not (checkout / script).is_file():
            remedy = f"git clone --recursive {program.url}; the commands are of commit {program.commit[:10]}."
            raise InputError(checkout, script, f"the checkout of {name}", "no such file", remedy)
    for file in program.files:
        if not (checkout / file).exists():
            raise InputError(checkout, file, f"a file that {name} needs", "no such file", program.remedy)


def check_interpreter(name: str, python: str, option: str = "--python") -> Path:
    """Path of an interpreter with the modules of a program. Raises `InputError` if it or one of these is missing.
    ``option`` is the one that names it, for messages."""
    program = PROGRAMS[name]
    interpreter = shutil.which(python)
    if interpreter is None:
        raise InputError("command line", option, f"the interpreter of the environment of {name}", python)
    path = Path(interpreter).absolute()
    command = [str(path), "-c", f"import {', '.join(program.modules)}"]
    remedy = f"Give the interpreter of the environment that the page of {name} makes."
    expected = f"the modules {', '.join(program.modules)}"
    with tempfile.TemporaryDirectory() as elsewhere:  # the checkout itself is not importable there
        try:
            completed = subprocess.run(
                command,
                cwd=elsewhere,
                env=environment(),
                capture_output=True,
                text=True,
                timeout=IMPORT_TIMEOUT_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise InputError(path, "", expected, f"none within {IMPORT_TIMEOUT_S:g} s", remedy) from None
    if completed.returncode:
        message = completed.stderr.strip().splitlines()[-1:] or [described(completed.returncode)]
        raise InputError(path, "", expected, message[0], remedy)
    return path


def run_steps(
    name: str,
    program: TrackingProgram,
    checkout: Path,
    interpreter: Path,
    work: WorkingFolder,
    progress: Progress,
) -> None:
    """Run the steps of a program that have not been finished for this video and checkout.

    Finished steps are kept in ``steps.json`` of the working folder, all output in ``program.log``.

    Raises `ProgramError` with the last lines of a step that fails or does not write its output.
    """
    record = work.folder / STEPS
    finished: dict[str, str] = read_json(record) if record.exists() else {}
    # Scripts call "python" through the shell.
    path = os.pathsep.join([str(interpreter.parent), os.environ.get("PATH", "")])
    variables = {"PATH": path, **program.variables(checkout, work)}
    video = digest_file(work.video)
    unchanged = True  # a step is repeated if one before it was
    for number, step in enumerate(program.steps):
        command = [str(interpreter), *step.arguments(work)]
        state = digest(command, str(checkout), video)
        pattern = step.output.format(name=work.name)
        unchanged = unchanged and finished.get(step.name) == state and any(work.folder.glob(pattern))
        if unchanged:
            continue
        for old in [*work.folder.glob(pattern)]:  # otherwise a step that writes nothing would go unnoticed
            shutil.rmtree(old) if old.is_dir() else old.unlink()
        note = f"{name}, {step.name}"

        def show(line: str, number: int = number, note: str = note) -> None:
            progress(number, len(program.steps), f"{note}: {line[:60]}" if line else note)

        show("")
        result = run_program(command, checkout, work.folder / LOG, show, variables=variables)
        if result.code:
            raise result.error(f"{name}: {step.name} {described(result.code)}")
        if not any(work.folder.glob(pattern)):
            raise result.error(f"{name}: {step.name} wrote no {pattern} in {work.folder}")
        finished[step.name] = state
        write_json(record, finished)


@dataclass(frozen=True)
class ProgramPlace:
    """Where a tracker is installed."""

    checkout: str = ""
    """Folder of its repository."""

    python: str = "python3"
    """Interpreter of its environment."""


def vhap(settings: Mapping[str, Any], device: str) -> Iterator[Need]:
    """Checkout of VHAP with FLAME, and its environment."""
    return _needs("vhap", settings)


def pixel3dmm(settings: Mapping[str, Any], device: str) -> Iterator[Need]:
    """Checkout of Pixel3DMM with its weights, and its environment."""
    return _needs("pixel3dmm", settings)


def _needs(name: str, settings: Mapping[str, Any]) -> Iterator[Need]:
    """Needs of a program."""
    place = build(ProgramPlace, settings, "command line", f"--set settings.{name}.")
    if not place.checkout:
        remedy = (
            f"git clone --recursive {PROGRAMS[name].url}, install it as its page says, and give "
            f"--set settings.{name}.checkout=DIR --set settings.{name}.python=FILE."
        )
        yield Need("checkout and environment", "", remedy)
        return
    checkout = Path(place.checkout).absolute()
    try:
        check_checkout(name, checkout)
    except InputError as error:
        yield Need("checkout", "", str(error))
    else:
        yield Need("checkout", str(checkout))
    try:
        yield Need(
            "environment", str(check_interpreter(name, place.python, f"--set settings.{name}.python=FILE"))
        )
    except InputError as error:
        yield Need("environment", "", str(error))


CAPTURE = "capture"
"""Folder of the capture, beside that of the program."""

if TYPE_CHECKING:
    from .settings import TrackSettings


def track_with_program(settings: TrackSettings, progress: Progress) -> CommandResult:
    """Run another tracker on the file of a video and convert its output to a capture. Its files are in a folder of its
    name in ``settings.out``, the capture beside it. A repeated call resumes after the last finished step."""
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
    imported = import_tracking(given, progress)
    return CommandResult(f"{message}\n{imported.text}", imported.data)
