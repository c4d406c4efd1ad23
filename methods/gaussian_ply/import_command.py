"""``headbench import ga``: GaussianAvatars' PLY as an avatar of ours."""

from __future__ import annotations

from pathlib import Path

from ...bench.contracts import Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.lock import LOCK_FILE
from ...bench.specs import Findings
from ...datasets.ga.reader import read_capture
from ..ga.storage import PLY_FILE, read_ga_splats, write_ga_splats
from ..shared.avatar_files import HEAD_FILE, SUBJECT_FILE, Subject, save_shared_head, write_subject
from .settings import ImportGASettings


def run(settings: ImportGASettings, progress: Progress = no_progress) -> Findings:
    """Check a PLY against a capture's mesh and write an avatar's folder.

    Harmonics of a lower degree are filled up with zeros, and whatever other columns there are is left out. Tracking
    that the training refined is in another file (`flame_param.npz`) and is not read: the avatar follows the capture's.
    Raises `InputError` for a file that does not fit, and for a folder that holds something already.
    """
    ply, out = Path(settings.ply), Path(settings.out)
    ours = {LOCK_FILE, SUBJECT_FILE, HEAD_FILE}  # an avatar's only with its splats, which are written last
    if out.exists() and any(path.name not in ours for path in out.iterdir()):
        raise InputError(out, "", "a new or an empty folder", "one with files in it")
    clip = read_capture(settings.capture, head=settings.head, progress=progress)
    splats, binding = read_ga_splats(ply, len(clip.head.faces), "cpu")
    write_subject(out / SUBJECT_FILE, Subject.of(clip))
    save_shared_head(out, clip.head)
    write_ga_splats(out / PLY_FILE, splats, binding)
    used = len(binding.unique())
    text = (
        f"{out}: {len(binding)} splats on {used} of {len(clip.head.faces)} triangles, subject {clip.subject}"
    )
    return Findings(text, {"out": out, "splats": len(binding), "triangles": used, "subject": clip.subject})
