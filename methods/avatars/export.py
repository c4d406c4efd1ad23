"""Export of avatars in one pose as splat files for viewers, and the loss of quality."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from ...bench.contracts import HeadAsset, HeadPose, Progress, SplatAvatar, no_progress
from ...bench.engine.stored import StoredAvatar, open_avatar
from ...bench.errors import InputError
from ...bench.io.files import check_writable
from ...bench.specs import CommandResult, command
from ..ops.harmonics import harmonic_colors
from ..shared.avatar_files import read_shared_head
from ..shared.rendering import view_of
from ..splats import rasterize
from .formats import FORMATS, StoredSplats
from .harmonics import DEGREE, harmonics_of
from .settings import AvatarOptions, ExportGlbSettings, ExportOptions, ExportPlySettings, ExportSogSettings
from .views import FIELD_OF_VIEW, direction_of, orbit_camera
from .web.bake import Source

VIEWS = ((0.0, 0.0), (0.6, 0.0), (-0.6, 0.2))
"""Azimuth and elevation, radians, of the views in which the loss is measured."""
SIZE = 400


def open_splats(settings: AvatarOptions) -> tuple[StoredAvatar, SplatAvatar]:
    """The stored avatar named by a command, and the loaded avatar.

    Raises `InputError` as `open_avatar` and `StoredAvatar.load` do, and for an avatar without splats.
    """
    stored = open_avatar(Path(settings.avatar), settings.method)
    avatar = stored.load()
    if not isinstance(avatar, SplatAvatar):
        found = f"one of {stored.record['method']}"
        remedy = "`headbench view` and `headbench render` show it."
        raise InputError(stored.folder, "", "an avatar of splats", found, remedy)
    return stored, avatar


@command("export ply", group="export")
def export_ply(settings: ExportPlySettings, progress: Progress = no_progress) -> CommandResult:
    """Write an avatar in one pose as a 3D Gaussian splatting PLY."""
    return export_pose(settings, "ply", progress)


@command("export glb", group="export")
def export_glb(settings: ExportGlbSettings, progress: Progress = no_progress) -> CommandResult:
    """Write an avatar in one pose as binary glTF with splats."""
    return export_pose(settings, "glb", progress)


@command("export sog", group="export")
def export_sog(settings: ExportSogSettings, progress: Progress = no_progress) -> CommandResult:
    """Write an avatar in one pose as SOG, a compact format of web viewers."""
    return export_pose(settings, "sog", progress)


def export_pose(settings: ExportOptions, name: str, progress: Progress) -> CommandResult:
    """Write an avatar in one pose in a format of `FORMATS`, read it back, and compare.

    Raises `InputError` for a folder without an avatar of splats, and for a timestep that the capture lacks;
    `UnavailableError` where the format's library is not installed.
    """
    out, form = Path(settings.out), FORMATS[name]
    check_writable(out, "--out")
    form.check()
    stored, avatar = open_splats(settings)
    pose = _pose(settings, read_shared_head(stored.folder), progress)
    splats = avatar.splats(pose)
    colours = harmonics_of(avatar, pose, settings.directions)
    form.write(out, StoredSplats.of(splats, colours.dc, colours.rest))
    lost = _least_psnr(avatar, pose, form.read(out))
    data = {"out": out, "splats": len(splats.means), "timestep": pose.timestep}
    data |= {"bytes": out.stat().st_size, "psnr": lost}
    words = "its own spherical harmonics"
    if colours.residual is not None:
        # Nearly invisible splats would hide the error of visible ones.
        weight = splats.opacities / max(float(splats.opacities.sum()), 1e-12)
        residual = colours.residual
        data["residual_rms"] = float(np.sqrt((weight * residual.numpy() ** 2).sum()))
        data["residual_p95"] = float(torch.quantile(residual, 0.95)) if len(residual) else 0.0
        words = f"spherical harmonics fitted to its colours, off by {data['residual_rms']:.4f} (rms)"
        words += f", {data['residual_p95']:.4f} (95 % of splats)"
    text = f"{out}: {len(splats.means)} splats, {out.stat().st_size / 1e6:.2f} MB; {words};"
    return CommandResult(f"{text} PSNR against the avatar's own frames {lost:.1f} dB or more", data)


def _least_psnr(avatar: SplatAvatar, pose: HeadPose, found: StoredSplats) -> float:
    """Minimum PSNR over `VIEWS`, dB: the file's splats rendered by this package against the avatar's frames, on white."""
    source = Source(avatar, pose, np.zeros(3), np.zeros((4, 3)))
    extent = np.quantile(source.seen(pose).means, (0.005, 0.995), axis=0)
    distance = float((extent[1] - extent[0]).max()) / np.tan(np.radians(FIELD_OF_VIEW))
    worst = np.inf
    for azimuth, elevation in VIEWS:
        camera = source.camera(
            orbit_camera(direction_of(azimuth, elevation), 1.5 * distance, extent.mean(axis=0), SIZE)
        )
        view = view_of(camera, "cpu", (1.0, 1.0, 1.0))
        colors = harmonic_colors(found.dc, found.rest, found.means - view.center, DEGREE)
        drawn = rasterize(
            *(found.means, found.quats, found.scales, found.opacities, colors),
            *(view.world_to_camera, view.K, camera.width, camera.height),
            background=view.background,
        )
        error = float(np.square(drawn.image.clamp(0, 1).numpy() - avatar.render(camera, pose).rgb).mean())
        worst = min(worst, -10 * float(np.log10(max(error, 1e-12))))
    return worst


def _pose(settings: ExportOptions, head: HeadAsset, progress: Progress) -> HeadPose:
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
    """Neutral pose: zero expression, rotations and translation."""
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
