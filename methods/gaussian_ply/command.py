"""``headbench export ply``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...bench.contracts import HeadAsset, HeadPose, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.files import check_writable
from ...bench.specs import Findings
from ...datasets.ga.reader import read_capture
from ..compact.file import COMPACT_FILE
from ..ga.method import GAAvatar
from ..ga.storage import PLY_FILE
from ..gbs.avatar import GBSAvatar
from ..insta.storage import FIELD_FILE as RADIANCE_FILE
from ..ours.avatar import OursAvatar
from ..ours.storage import FIELD_FILE
from ..shared.avatar_files import read_shared_head
from ..shared.tensor_files import read_safetensors
from .harmonics import fit_harmonics, sphere, turn_harmonics, write_gaussians
from .settings import ExportPlySettings

EXPORTED = "an avatar of ours, ga or gbs"
DRAWN = "A PLY cannot hold it; `headbench extremes` and `headbench reenact` draw its frames."


def run(settings: ExportPlySettings, progress: Progress = no_progress) -> Findings:
    """Write one pose of an avatar; its findings state how well harmonics take up its colours.

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
        colours = (
            f"harmonics fitted to the planes' colours: off by {mean:.4f} (rms), {worst:.4f} (95 % of splats)"
        )
    text = f"{out}: {len(splats.means)} splats, {out.stat().st_size / 1e6:.1f} MB; {colours}"
    return Findings(text, data)


def _read(folder: Path) -> GAAvatar | GBSAvatar | OursAvatar:
    if (folder / PLY_FILE).exists():
        return GAAvatar.read(folder, "cpu")
    if (folder / COMPACT_FILE).exists():
        return OursAvatar.read(folder, "cpu")
    names = _tensor_names(folder / FIELD_FILE)
    if "differences" in names:
        return GBSAvatar.read(folder, "cpu")
    if "table" in names:
        found = "an avatar of gha, whose splats are features that a network turns into colours"
        raise InputError(folder, "", EXPORTED, found, DRAWN)
    if names:
        return OursAvatar.read(folder, "cpu")
    if (folder / RADIANCE_FILE).exists():
        raise InputError(folder, "", EXPORTED, "an avatar of insta, a radiance field without splats", DRAWN)
    remedy = (
        "The avatars of a run lie in the folder avatars/ inside its own."
        if (folder / "run.json").exists()
        else ""
    )
    expected = f"{EXPORTED}: {PLY_FILE}, {FIELD_FILE} or {COMPACT_FILE}"
    raise InputError(folder, "", expected, "none of them", remedy)


def _tensor_names(path: Path) -> set[str]:
    """Names of a file's tensors, which show whose avatar it is; empty where there is no such file."""
    return set(read_safetensors(path)[0]) if path.exists() else set()


def _pose(settings: ExportPlySettings, head: HeadAsset, progress: Progress) -> HeadPose:
    if settings.capture is None:
        return neutral_pose(head)
    clip = read_capture(settings.capture, head=settings.head, progress=progress)
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
