"""Avatars in one pose as PLY files of splats, and GaussianAvatars' PLY files as avatars."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...bench.contracts import HeadAsset, HeadPose, Progress
from ...bench.errors import InputError
from ...bench.io.files import check_writable
from ...bench.io.lock import LOCK_FILE
from ...bench.specs import Findings
from ..compact.file import COMPACT_FILE
from ..ga.method import GAAvatar
from ..ga.storage import COLUMNS, PLY_FILE, read_ga_splats, write_ga_splats
from ..gbs.avatar import GBSAvatar
from ..insta.avatar import FIELD_FILE as RADIANCE_FILE
from ..ours.avatar import OursAvatar
from ..ours.storage import FIELD_FILE
from ..shared.avatar_files import (
    HEAD_FILE,
    SUBJECT_FILE,
    Subject,
    read_shared_head,
    save_shared_head,
    write_subject,
)
from ..shared.ply import read_names
from ..shared.tensor_files import read_safetensors
from .command import ExportPlySettings, ImportGASettings
from .harmonics import fit_harmonics, sphere, turn_harmonics, write_gaussians

EXPORTED = "an avatar of ours, ga or gbs"
DRAWN = "A PLY cannot hold it; `headbench extremes` and `headbench reenact` draw its frames."


def export_avatar(settings: ExportPlySettings, progress: Progress) -> Findings:
    """Write an avatar in one pose as a 3D Gaussian splatting PLY.

    Raises `InputError` for a folder that holds no avatar of ours, ga or gbs, and for a timestep that the capture lacks.
    """
    folder, out = Path(settings.avatar), Path(settings.out)
    check_writable(out, "--out")
    avatar = _read(folder)
    pose = _pose(settings, read_shared_head(folder), progress)
    splats = avatar.splats(pose)
    data: dict[str, Any] = {"out": out, "splats": len(splats.means), "timestep": pose.timestep}
    if isinstance(avatar, GAAvatar):
        write_gaussians(out, splats, *avatar.harmonics())
        colours = "its own spherical harmonics, exactly"
    elif isinstance(avatar, GBSAvatar):
        write_gaussians(out, splats, *turn_harmonics(*avatar.harmonics(pose)))
        colours = "its spherical harmonics in this pose, turned with the surface"
    else:
        seen_from = avatar.seen_from(pose)
        fit = fit_harmonics(seen_from.radiance, seen_from.normals, sphere(settings.directions))
        write_gaussians(out, splats, fit.dc, fit.rest)
        # Splats that hardly show would hide how far off those are that do.
        weight = splats.opacities / max(float(splats.opacities.sum()), 1e-12)
        mean = float(np.sqrt((weight * fit.residual.numpy() ** 2).sum()))
        worst = float(torch.quantile(fit.residual, 0.95)) if len(fit.residual) else 0.0
        data |= {"residual_rms": mean, "residual_p95": worst}
        off = f"off by {mean:.4f} (rms), {worst:.4f} (95 % of splats)"
        colours = f"harmonics fitted to the planes' colours: {off}"
    text = f"{out}: {len(splats.means)} splats, {out.stat().st_size / 1e6:.1f} MB; {colours}"
    return Findings(text, data)


def _read(folder: Path) -> GAAvatar | GBSAvatar | OursAvatar:
    if (folder / PLY_FILE).exists():
        foreign = [name for name in read_names(folder / PLY_FILE) if name not in COLUMNS]
        if foreign:
            found = "a column of another method, which would be lost"
            raise InputError(folder / PLY_FILE, foreign[0], EXPORTED, found)
        return GAAvatar.read(folder, "cpu")
    if (folder / COMPACT_FILE).exists():
        return OursAvatar.read(folder, "cpu")
    path = folder / FIELD_FILE
    names = set(read_safetensors(path)[0]) if path.exists() else set()
    if "differences" in names:
        return GBSAvatar.read(folder, "cpu")
    if "table" in names:
        found = "an avatar of gha, whose splats are features that a network turns into colours"
        raise InputError(folder, "", EXPORTED, found, DRAWN)
    if names:
        return OursAvatar.read(folder, "cpu")
    if (folder / RADIANCE_FILE).exists():
        raise InputError(folder, "", EXPORTED, "an avatar of insta, a radiance field without splats", DRAWN)
    remedy = "The avatars of a run lie in SUBJECT/METHOD/seed-N/avatar inside its folder."
    expected = f"{EXPORTED}: {PLY_FILE}, {FIELD_FILE} or {COMPACT_FILE}"
    raise InputError(folder, "", expected, "none of them", remedy if (folder / "run.json").exists() else "")


def _pose(settings: ExportPlySettings, head: HeadAsset, progress: Progress) -> HeadPose:
    if settings.capture is None:
        return neutral_pose(head)
    clip = settings.open(settings.capture, progress)
    timestep = settings.timestep
    if timestep is None:
        timestep = min(key.timestep for key in clip.splits["train"])
    if timestep not in clip.poses:
        expected = f"a timestep of the capture, {min(clip.poses)} to {max(clip.poses)}"
        raise InputError("--timestep", "", expected, str(timestep))
    return clip.poses[timestep]


def neutral_pose(head: HeadAsset) -> HeadPose:
    """Nothing moved: zero expression, rotations and translation."""
    zero = np.zeros(3, np.float32)
    return HeadPose(
        head.version,
        expression=np.zeros(head.expression_basis.shape[2], np.float32),
        rotation=zero,
        neck=zero,
        jaw=zero,
        eyes=np.zeros(6, np.float32),
        translation=zero,
        eyelids=None if head.eyelid_basis is None else np.zeros(2, np.float32),
    )


def import_avatar(settings: ImportGASettings, progress: Progress) -> Findings:
    """Make an avatar of a GaussianAvatars PLY and the capture it was trained on.

    Raises `InputError` for a file that does not fit, and for a folder that holds something already.
    """
    ply, out = Path(settings.ply), Path(settings.out)
    ours = {LOCK_FILE, SUBJECT_FILE, HEAD_FILE, PLY_FILE}
    other = InputError(out, "", "a new or an empty folder", "one with files in it")
    if out.exists() and any(path.name not in ours for path in out.iterdir()):
        raise other
    clip = settings.open(settings.capture, progress)
    splats, binding = read_ga_splats(ply, len(clip.head.faces), "cpu")
    # The splats are written last: those of this import, killed at its end, or others.
    if (out / PLY_FILE).exists():
        there, on = read_ga_splats(out / PLY_FILE, len(clip.head.faces), "cpu")
        if not (binding.equal(on) and all(splats[name].equal(there[name]) for name in splats)):
            raise other
    write_subject(out / SUBJECT_FILE, Subject.of(clip))
    save_shared_head(out, clip.head)
    write_ga_splats(out / PLY_FILE, splats, binding)
    used = len(binding.unique())
    triangles = f"{used} of {len(clip.head.faces)} triangles"
    text = f"{out}: {len(binding)} splats on {triangles}, subject {clip.subject}"
    return Findings(text, {"out": out, "splats": len(binding), "triangles": used, "subject": clip.subject})
