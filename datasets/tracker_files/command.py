"""``headbench import tracking``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from ...bench.contracts import Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.files import write_json
from ...bench.manifest import cut_of
from ...bench.progress import counted
from ...bench.protocol import evenly_with_ends
from ...bench.specs import CommandResult, command
from ..options import Cut


@dataclass(frozen=True)
class ImportTrackingSettings:
    """Settings of ``headbench import tracking``."""

    source: Annotated[str, tyro.conf.Positional]
    """Output of a tracker: the folder with checkpoint/00000.frame, or checkpoint itself."""

    head: str
    """Head model that the tracker used: FLAME pickle or npz, or a version of the procedural head. Metrical Tracker uses FLAME
    2020."""

    out: str
    """Folder for the capture, import.json and overlay.png."""

    format: str = ""
    """metrical (Metrical Tracker, FlashAvatar) or pixel3dmm; default: recognised by the files."""

    images: str = ""
    """Folder of the images that were tracked, cropped and resized as the tracker read them, named by numbers; default: imgs,
    input or images (metrical), cropped (pixel3dmm), in the tracker's folder or beside it."""

    first_image: int | None = None
    """Number in the name of the image of frame 0; default: 0 in input and cropped, 1 in imgs as in FlashAvatar, else the
    lowest number in the folder."""

    masks: str = ""
    """Folder of masks named as the images; default: alpha or mask beside the images, times parsing/*_neckhead if there are
    any (metrical); seg_og (pixel3dmm); or the alpha channels of the images."""

    cut: Cut = "bust-line"
    """Part of the person that is replaced by background, since no head model explains it: all below a line through the front of
    the neck's lower end, as VHAP's export does, or nothing."""

    parsing: str = ""
    """Folder of label images (19 classes of CelebAMask-HQ) named as the images: clothes are cut by them instead."""

    subject: str = ""
    """Name of the subject; default: that of the folder."""

    held_out_frames: int | None = None
    """Number of last frames held out for self-reenactment; default: 350, or a quarter of fewer than 700."""

    @staticmethod
    def notes() -> str:
        """More text for the help."""
        return (
            "Exports of VHAP (videos of one camera or several) need no import: the reader ga reads them, and every command "
            "takes their folder. The files of INSTA's generate.sh are read by the reader monocular. SMIRK, DECA and EMOCA "
            "estimate expressions in crops without a camera, from which no capture can be made."
        )


if TYPE_CHECKING:
    from ..clip import CaptureClip
    from .frames import VideoPictures

REPORT, PICTURE = "import.json", "overlay.png"
SHOWN = 6
"""Timesteps of the picture."""


@command("import tracking", group="data", writes="out", kinds=("captures",))
def import_tracking(settings: ImportTrackingSettings, progress: Progress = no_progress) -> CommandResult:
    """Make a capture from the files of another tracker and the frames of the video.

    Writes under ``settings.out`` ``overlay.png`` with the mesh over a few images, the capture (PNG images without separate
    masks are linked, others are composited on white), and ``import.json``.
    """
    from ..clip import check_apart
    from ..ga.writer import capture_plan, write_capture
    from ..head.refit.command import target_head
    from ..images import write_image
    from ..inspect.figure import draw_overlay
    from ..monocular.clip import clip_of_track, subject_of
    from ..steps.masks import without_torso
    from .formats import recognise
    from .frames import FOLDER, find_pictures, frame_files, left_out, read_frames, video_track

    root, out = Path(settings.source), Path(settings.out)
    if not settings.format:
        _check_unknown_to_readers(root)
    form = recognise(root, settings.format)
    files = frame_files(root)
    if root.resolve().name == FOLDER:
        root = root.resolve().parent
    head = target_head(settings.head, "--head")
    frames = read_frames(files, form.members, form.convert)
    pictures = find_pictures(
        root, form.layout, [*files], settings.images, settings.masks, settings.first_image
    )
    track = video_track(root, frames, pictures, head, resized=form.layout.resized)
    clip = clip_of_track(
        root,
        track,
        head,
        subject=settings.subject or subject_of(root.resolve()),
        held_out_frames=settings.held_out_frames,
        use_cache=False,
        progress=progress,
    )
    clip = without_torso(clip, settings.cut, settings.parsing)
    capture_plan(clip, root)  # Captures that cannot be written are detected before anything is.
    check_apart(clip, out)
    timesteps = evenly_with_ends(sorted(clip.poses), SHOWN)
    write_image(out / PICTURE, draw_overlay(clip, timesteps, [*clip.cameras]))
    union = write_capture(clip, out, progress)
    lost = left_out(frames, head)
    data: dict[str, Any] = {
        "capture": union.as_posix(),
        "format": form.name,
        "frames": len(frames),
        "held_out": clip.steps[0].parameters["held_out"],
        "images": pictures.folder.as_posix(),
        "first_image": pictures.first,
        "masks": pictures.masks,
        "cut": cut_of(map(asdict, clip.steps)),
        "left_out": dict(lost),
    }
    write_json(out / REPORT, data)
    return CommandResult("\n".join(_text(form.summary, clip, pictures, lost, out, union)), data)


def _check_unknown_to_readers(root: Path) -> None:
    """Raise `InputError` if a reader of captures can read the folder directly."""
    from ...bench.registry import finds, readers

    for name, spec in readers().items():
        if finds(spec, root):
            expected = "files of a tracker that no reader of captures reads"
            remedy = f"No import is needed: give the folder to `headbench lint` and `headbench run` (reader {name})."
            raise InputError(root, "", expected, f"a capture that the reader {name} reads", remedy)


def _text(
    summary: str, clip: CaptureClip, pictures: VideoPictures, lost: Mapping[str, str], out: Path, union: Path
) -> list[str]:
    (camera,) = clip.cameras.values()
    masks = pictures.masks or (
        "none, so that the room behind the subject is part of every image; "
        "make masks (alpha or mask beside the images, or --masks) and import again"
    )
    held_out = clip.steps[0].parameters["held_out"]
    lines = [
        f"Read: {summary}",
        f"  frames    {len(clip.files)}, {camera.width}x{camera.height} pixels; held out: {held_out}",
        f"  images    {pictures.folder}, image {pictures.first} is frame 0",
        f"  masks     {masks}",
        *(f"  left out  {name.replace('_', ' ')}: {words}" for name, words in lost.items()),
    ]
    if pictures.unused:
        lines.append(f"  not used  {counted(pictures.unused, 'image')} without a tracked frame")
    return [
        *lines,
        f"Look at {out / PICTURE}: if the mesh is beside the head, the images or --first-image are wrong.",
        f"Then: headbench lint {union}",
        f"Capture: {union}",
    ]
