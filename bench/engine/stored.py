"""Stored avatars: ``avatar.json``, which describes the avatar in its folder, and `load_avatar`."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from typing_extensions import TypedDict

from ..configuration import build
from ..contracts import Avatar, Budget, Clip, FloatArray
from ..errors import InputError
from ..io.arrays import MAX_MAGNITUDE, check_numbers
from ..io.documents import checked, read_json
from ..io.files import digest, digest_file, entries, is_system_file, write_json
from ..io.provenance import tool
from ..registry import discover, get, resolve
from ..specs import MethodSpec, ResolutionRule
from .config import AVATAR_FOLDER, ResolvedMethod

log = logging.getLogger(__name__)

AVATAR_FILE = "avatar.json"
"""File in the folder of every avatar, see `AvatarRecord`."""
HEAD_FILE = "head_model.npz"
"""Head model file in an avatar's folder, which all native methods store."""
SUBJECT_FILE = "subject.npz"
"""File with the subject's shape and static offset, which most methods store."""
TRAINING_FILE = "training.json"
"""Training record of methods; optional "losses" are pairs of an iteration and the loss up to it."""
SAME_SHAPE = 1e-4
"""Tolerance between shape coefficients of the same subject; files store float32."""

Maker = Literal["training", "import", "compact", "variant"]


class AvatarRecord(TypedDict):
    """Content of ``avatar.json``."""

    format: Literal[1]
    """Format of this file."""
    method: str
    """Registered name of the method that reads the avatar. ``version`` is that of the method that wrote it."""
    version: str
    settings: dict[str, Any] | None
    """Complete configuration of the method; None for a method without settings."""
    resolution: ResolutionRule
    """Image size that the method uses with these settings."""
    subject: str
    shape: list[float]
    """``subject``, ``shape``: Name and (S,) identity coefficients of the subject."""
    head_model: str
    """Version of the head model whose poses animate the avatar."""
    head_digest: str
    """SHA-256 of `HEAD_FILE` in the same folder; "" without one."""
    made_by: Maker
    """"training", "import" of another program's file, "compact" storage, or derived as a "variant"."""
    origin: dict[str, Any]
    """Inputs of the avatar: seed, budget and fingerprint of the capture, or digest of the file or avatar."""


def write_avatar_record(
    folder: Path,
    method: ResolvedMethod,
    subject: str,
    shape: FloatArray | Sequence[float],
    head_model: str,
    made_by: Maker,
    origin: Mapping[str, Any],
) -> None:
    """Write ``avatar.json`` into the folder of an avatar whose other files are complete; see `AvatarRecord`."""
    head = folder / HEAD_FILE
    record: AvatarRecord = {
        "format": 1,
        "method": registered_name(method),
        "version": method.spec.version,
        "settings": None if method.config is None else asdict(method.config),
        "resolution": method.spec.resolution,
        "subject": subject,
        "shape": np.asarray(shape, np.float32).tolist(),
        "head_model": head_model,
        "head_digest": digest_file(head) if head.is_file() else "",
        "made_by": made_by,
        "origin": {"tool": tool(), **origin},
    }
    write_json(folder / AVATAR_FILE, record)


def shown_by(clip: Clip) -> tuple[str, FloatArray, str]:
    """Subject, shape and head model version of the clip that an avatar is trained on."""
    versions = (pose.head_model for pose in clip.poses.values())
    return clip.subject, clip.shape, next(versions, "")


def registered_name(method: ResolvedMethod) -> str:
    """Name of a method without the suffix of its settings."""
    label, name = getattr(method.config, "label", ""), method.spec.name
    return name.removesuffix(f" ({label})") if label else name


def avatar_folder(folder: Path) -> Path:
    """The folder with the files of an avatar: this one, or ``avatar`` in the cell of a run."""
    inside = folder / "avatar"
    avatar = inside if inside.is_dir() else folder
    if not avatar.is_dir() or not any(path.is_file() for path in entries(avatar)):
        reason = "no such folder" if not avatar.is_dir() else "one without files"
        raise InputError(folder, "", f"the {AVATAR_FOLDER}", reason)
    return avatar


@dataclass(frozen=True)
class StoredAvatar:
    """An avatar that is not loaded yet: its folder, its record, and the method that reads it, with settings."""

    folder: Path
    record: AvatarRecord
    method: ResolvedMethod

    def load(self, device: str = "cpu") -> Avatar:
        """Read the avatar."""
        head, recorded = self.folder / HEAD_FILE, self.record["head_digest"]
        if recorded and not head.is_file():
            raise InputError(head, "", "the head model that the avatar was stored with", "no such file")
        if recorded and (current := digest_file(head)) != recorded:
            expected = f"the head model that the avatar was stored with, SHA-256 {recorded[:12]}"
            raise InputError(head, "", expected, f"another, SHA-256 {current[:12]}")
        avatar: Avatar = self.method.create().load(self.folder, device=device)
        return avatar

    @property
    def heads(self) -> dict[str, str]:
        """Head model file of the avatar by version, for `adaptation.plan` to refit a capture."""
        return {self.record["head_model"]: str(self.folder / HEAD_FILE)} if self.record["head_digest"] else {}

    def check_subject(self, clip: Clip) -> None:
        """Raise `InputError` if the avatar shows another subject than a clip."""
        shown = self.shows_another(*shown_by(clip))
        if shown:
            expected = f"an avatar of {clip.subject}, whom the capture shows"
            raise InputError(self.folder, "subject", expected, f"one of {shown}")

    def shape_of(self, version: str, size: int) -> FloatArray | None:
        """(S,) shape of the avatar's subject for a head model of this version and size; None for another model."""
        own = np.asarray(self.record["shape"])
        return own if self.record["head_model"] == version and own.shape == (size,) else None

    def shows_another(self, subject: str, shape: FloatArray, head_model: str) -> str:
        """Name of the avatar's subject if it is not the given one, otherwise "".

        The shape decides if the head models are the same, otherwise the name: shapes of different models are not comparable.
        """
        name, own = self.record["subject"], self.shape_of(head_model, len(shape))
        if own is not None:
            return name if np.abs(own - shape).max(initial=0.0) > SAME_SHAPE else ""
        return name if name != subject else ""


def open_avatar(folder: Path, method: str = "") -> StoredAvatar:
    """Read ``avatar.json`` of a folder, see `avatar_folder`, and find the method that reads the avatar.

    Parameters
    ----------
    method : str
        "module:SPEC" of a method that is not registered; "" uses the name in ``avatar.json``.
    """
    home = avatar_folder(folder)
    path = home / AVATAR_FILE
    if not path.is_file():
        remedy = "It is written when a training, an import or `headbench export compact` ends."
        if (folder / "run.json").is_file():
            remedy = "The avatars of a run are in SUBJECT/METHOD/seed-N/avatar in its folder."
        raise InputError(
            folder, AVATAR_FILE, f"the {AVATAR_FOLDER}", f"a folder without {AVATAR_FILE}", remedy
        )
    record: AvatarRecord = checked(read_json(path), AvatarRecord, path)
    check_numbers(path, "shape", np.asarray(record["shape"]), MAX_MAGNITUDE)
    if record["made_by"] == "variant":
        remedy = f"Load the trained avatar of {record['method']}, which it was derived from, or what "
        remedy += "`headbench export compact` makes of that."
        derived = "a variant, as `headbench run sweep` and the condition `coded` derive it"
        raise InputError(path, "made_by", "an avatar that its method reads", derived, remedy)
    name = method or record["method"]
    if not method and name not in discover("methods"):
        remedy = "Install the package that registers it, or name it: --method package.module:SPEC, in Python method='package.module:SPEC'."
        raise InputError(path, "method", "a method that is registered here", repr(name), remedy)
    spec: MethodSpec = get("methods", name)
    if method and spec.name != record["method"]:
        raise InputError("command line", "--method", f"{record['method']}, which {path} states", spec.name)
    if spec.version != record["version"]:
        log.warning(
            "%s: made by version %s of %s, read by version %s",
            *(home, record["version"], spec.name, spec.version),
        )
    return StoredAvatar(home, record, _resolved(spec, record, path))


def _resolved(spec: MethodSpec, record: AvatarRecord, path: Path) -> ResolvedMethod:
    """The method with the settings of the record."""
    settings = record["settings"]
    if bool(spec.config) != (settings is not None):
        expected = "settings" if spec.config else "none: this method has no settings"
        raise InputError(path, "settings", expected, "none" if settings is None else "some")
    config = None if settings is None else build(resolve(spec.config), settings, str(path), "settings.")
    return ResolvedMethod(replace(spec, resolution=record["resolution"]), config, Budget())


def load_avatar(folder: Path | str, *, device: str = "cpu", method: str = "") -> Avatar:
    """Load an avatar that a run, an import or `headbench export compact` stored, whatever its method.

    Parameters
    ----------
    folder : Path | str
        Folder with ``avatar.json``, or the cell of a run (``RUN/SUBJECT/METHOD/seed-N``).
    device : str
        Rendering device.
    method : str
        "module:SPEC" of a method that is not registered; "" uses the name in ``avatar.json``.
    """
    return open_avatar(Path(folder), method).load(device)


def training_losses(folder: Path) -> list[tuple[int, float]]:
    """Recorded losses of an avatar's training, possibly none."""
    path = folder / TRAINING_FILE
    if not path.is_file():
        return []
    return checked(read_json(path).get("losses", []), list[tuple[int, float]], path, "losses")


def avatar_digest(folder: Path) -> str:
    """Digest of all files of an avatar, except logs of official programs and files of operating systems."""
    home = avatar_folder(folder)
    files = [path for path in home.rglob("*") if path.is_file() and path.suffix != ".log"]
    files = sorted(path for path in files if not is_system_file(path.name))
    return digest([[path.relative_to(home).as_posix(), digest_file(path)] for path in files])
