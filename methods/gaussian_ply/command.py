"""``headbench export ply`` and ``headbench import ga``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro

from ...bench.contracts import HeadAsset, HeadPose, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.files import check_writable
from ...bench.io.lock import LOCK_FILE
from ...bench.specs import Findings, writes
from ...datasets.options import CaptureOptions

if TYPE_CHECKING:
    from ..ga.method import GAAvatar
    from ..gbs.avatar import GBSAvatar
    from ..ours.avatar import OursAvatar


@dataclass(frozen=True)
class ExportPlySettings(CaptureOptions):
    """Write an avatar in one pose as a 3D Gaussian splatting PLY that common viewers open."""

    avatar: tyro.conf.Positional[str]
    """Folder of an avatar of ours, ga or gbs (RUN/avatars/...)."""

    out: str
    """PLY file to write."""

    capture: str | None = None
    """Capture with the pose to write; without one the pose is neutral."""

    timestep: int | None = None
    """Timestep of the capture; default: the first of its training frames."""

    directions: int = 96
    """Viewing directions, even over the sphere, at which colours that are not spherical harmonics are sampled."""

    def __post_init__(self) -> None:
        if self.timestep is not None and self.capture is None:
            raise ValueError("timestep needs a capture")
        if self.directions < 32:
            raise ValueError(
                f"directions must be at least 32, twice the coefficients, found {self.directions}"
            )


@dataclass(frozen=True)
class ImportGASettings(CaptureOptions):
    """Make an avatar of a GaussianAvatars PLY and the capture it was trained on."""

    ply: tyro.conf.Positional[str]
    """The PLY, with a column binding_0 (`point_cloud/iteration_<N>/point_cloud.ply`)."""

    capture: str
    """Capture, in a layout that a reader knows: it brings the head model, the shape and the static offset."""

    out: str
    """Folder to write; `headbench export ply` and the method ga load it."""


EXPORTED = "an avatar of ours, ga or gbs"
DRAWN = "A PLY cannot hold it; `headbench extremes` and `headbench reenact` draw its frames."


def export_ply(settings: ExportPlySettings, progress: Progress = no_progress) -> Findings:
    """Write an avatar in one pose as a 3D Gaussian splatting PLY that common viewers open.

    The findings state how well harmonics represent its colours.

    Raises `InputError` for a folder that holds no avatar of ours, ga or gbs, and for a timestep that the capture lacks.
    """
    import torch

    from ..ga.method import GAAvatar
    from ..gbs.avatar import GBSAvatar
    from ..shared.avatar_files import read_shared_head
    from .harmonics import fit_harmonics, sphere, turn_harmonics, write_gaussians

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
    from ..compact.file import COMPACT_FILE
    from ..ga.method import GAAvatar
    from ..ga.storage import PLY_FILE
    from ..gbs.avatar import GBSAvatar
    from ..insta.avatar import FIELD_FILE as RADIANCE_FILE
    from ..ours.avatar import OursAvatar
    from ..ours.storage import FIELD_FILE

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
    from ..shared.tensor_files import read_safetensors

    return set(read_safetensors(path)[0]) if path.exists() else set()


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


@writes("out")
def import_ga(settings: ImportGASettings, progress: Progress = no_progress) -> Findings:
    """Make an avatar of a GaussianAvatars PLY and the capture it was trained on.

    Harmonics of a lower degree are filled up with zeros, and whatever other columns there are is left out. Tracking
    that the training refined is in another file (`flame_param.npz`) and is not read: the avatar follows the capture's.
    Raises `InputError` for a file that does not fit, and for a folder that holds something already.
    """
    from ..ga.storage import PLY_FILE, read_ga_splats, write_ga_splats
    from ..shared.avatar_files import HEAD_FILE, SUBJECT_FILE, Subject, save_shared_head, write_subject

    ply, out = Path(settings.ply), Path(settings.out)
    ours = {LOCK_FILE, SUBJECT_FILE, HEAD_FILE, PLY_FILE}
    other = InputError(out, "", "a new or an empty folder", "one with files in it")
    if out.exists() and any(path.name not in ours for path in out.iterdir()):
        raise other
    clip = settings.open(settings.capture, progress)
    splats, binding = read_ga_splats(ply, len(clip.head.faces), "cpu")
    if (
        out / PLY_FILE
    ).exists():  # the splats are written last: those of this import, killed at its end, or others
        there, triangles = read_ga_splats(out / PLY_FILE, len(clip.head.faces), "cpu")
        if not (binding.equal(triangles) and all(splats[name].equal(there[name]) for name in splats)):
            raise other
    write_subject(out / SUBJECT_FILE, Subject.of(clip))
    save_shared_head(out, clip.head)
    write_ga_splats(out / PLY_FILE, splats, binding)
    used = len(binding.unique())
    text = (
        f"{out}: {len(binding)} splats on {used} of {len(clip.head.faces)} triangles, subject {clip.subject}"
    )
    return Findings(text, {"out": out, "splats": len(binding), "triangles": used, "subject": clip.subject})
