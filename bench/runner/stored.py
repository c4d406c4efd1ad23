"""Avatars that lie in a folder, of a run or of `headbench import`: which method reads one, and with which settings."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ..contracts import FloatArray, HeadAsset
from ..errors import InputError
from ..io.arrays import TEXT, Member, read_arrays
from ..io.documents import checked, read_json
from ..io.files import digest, digest_file, entries
from ..registry import get
from ..specs import MethodSpec
from .config import AVATAR_FOLDER, ResolvedMethod, default_names, resolve_method
from .store import RunFolder, avatar_files


def avatar_folder(folder: Path) -> Path:
    """The folder with the files of an avatar: this one, or ``avatar`` in the cell of a run. Raises `InputError`."""
    inside = folder / "avatar"
    found = inside if inside.is_dir() else folder
    if not found.is_dir() or not any(path.is_file() for path in entries(found)):
        reason = "no such folder" if not found.is_dir() else "one without files"
        raise InputError(folder, "", f"the {AVATAR_FOLDER}", reason)
    return found


def stored_method(folder: Path, method: str = "", preset: str = "") -> ResolvedMethod:
    """The method that made the avatar in a folder, as the run that the folder lies in resolved it.

    Parameters
    ----------
    method : its name, or "module:SPEC"; "" for that of the run.
    preset : decides the image size that some methods work at; "" for that of the run, else "fast".

    Raises
    ------
    InputError
        Where ``method`` is left out and no run tells it, and for names that are not known.
    """
    home = avatar_folder(folder).resolve()
    seed, of = home.parent.name, home.parent.parent.name
    run = RunFolder(home.parents[3]) if len(home.parents) > 3 else None
    inside = run is not None and home.name == "avatar" and re.fullmatch(r"seed-\d+", seed) is not None
    config = run.read_manifest().configuration if run and inside and run.manifest.is_file() else None
    if not method and config is None:
        expected = f"the method of the avatar: {', '.join(default_names('methods'))}, or another"
        raise InputError("command line", "--method", expected, "none, and the folder is not that of a run")
    spec: MethodSpec = get("methods", method or of)
    settings = {}
    if config is not None and spec.name == of:
        preset, settings = preset or config.preset, dict(config.settings.get(of, {}))
    preset = preset or ("fast" if "fast" in spec.presets or not spec.presets else next(iter(spec.presets)))
    return resolve_method(spec, preset, settings)


HEAD_FILE = "head_model.npz"
"""The head model beside an avatar, which all native methods store."""


def stored_heads(folder: Path) -> dict[str, str]:
    """File of the head model beside an avatar, by its version: what `adaptation.plan` refits a capture to; {} without one."""
    path = avatar_folder(folder) / HEAD_FILE
    return {str(read_arrays(path, {"version": TEXT})["version"]): str(path)} if path.is_file() else {}


SUBJECT_FILE = "subject.npz"
"""Where native avatars, imported ones and most official ones say whom they show."""
SAME_SHAPE = 1e-4
"""Largest difference of two shape coefficients of one subject; files hold float32."""


def shows_another(folder: Path, subject: str, head: HeadAsset, shape: FloatArray) -> str:
    """The name of the subject that a stored avatar shows, if that is another than the one given; "" where nobody knows.

    Another is who has another name and another shape; shapes of two head models do not compare.
    """
    path = avatar_folder(folder) / SUBJECT_FILE
    if not path.is_file():
        return ""
    found = read_arrays(path, {"name": TEXT, "head_model": TEXT, "shape": Member("f", (None,))})
    name, own = str(found["name"]), found["shape"]
    if str(found["head_model"]) == head.version and own.shape == np.shape(shape):
        return name if np.abs(own - shape).max(initial=0.0) > SAME_SHAPE else ""
    return name if name != subject else ""


TRAINING_FILE = "training.json"
"""Where methods record how a training went. Its "losses", if any, are pairs of an iteration and the loss up to there."""


def training_losses(folder: Path) -> list[tuple[int, float]]:
    """The losses that an avatar's training recorded; none where it recorded none. Raises `InputError` for a damaged record."""
    path = folder / TRAINING_FILE
    if not path.is_file():
        return []
    return checked(read_json(path).get("losses", []), list[tuple[int, float]], path, "losses")


def avatar_digest(folder: Path) -> str:
    """Digest of all files of an avatar; see `avatar_files`."""
    home = avatar_folder(folder)
    return digest([[path.relative_to(home).as_posix(), digest_file(path)] for path in avatar_files(home)])
