"""Avatars in one pose as files of splats that viewers open, and what each file loses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import HeadAsset, HeadPose, Progress
from ...bench.errors import InputError
from ...bench.io.files import check_writable
from ...bench.runner.stored import avatar_folder
from ...bench.specs import Findings
from ..compact.file import COMPACT_FILE
from ..ga.method import GAAvatar
from ..ga.storage import COLUMNS, PLY_FILE
from ..gbs.avatar import GBSAvatar
from ..gha.avatar import GHAAvatar
from ..insta.avatar import FIELD_FILE as RADIANCE_FILE
from ..ops.harmonics import C0, sh_basis
from ..ours.avatar import OursAvatar
from ..ours.storage import FIELD_FILE
from ..shared.avatar_files import read_shared_head
from ..shared.ply import read_names
from ..shared.tensor_files import read_safetensors
from ..splats import rasterize
from ..web.bake import Source
from ..web.model import FIELD_OF_VIEW, look
from .command import ExportOptions
from .formats import FORMATS, StoredSplats
from .harmonics import DEGREE, fit_harmonics, sphere, turn_harmonics

VIEWS = ((0.0, 0.0), (0.6, 0.0), (-0.6, 0.2))
"""Azimuth and elevation, radians, from which the loss is measured."""
SIZE = 400
PLAIN = "its colours before super-resolution, which no file of splats can hold"

SplatMethodAvatar = GAAvatar | GBSAvatar | OursAvatar | GHAAvatar
AVATARS: Mapping[str, type[SplatMethodAvatar]] = {
    "ours": OursAvatar,
    "ga": GAAvatar,
    "gbs": GBSAvatar,
    "gha": GHAAvatar,
}
"""Avatars of splats by the name of their method."""
NOT_HELD = {
    "insta": "a radiance field without splats",
    "gha": "whose splats are features that a network turns into colours",
}
"""Why a format cannot hold the avatars of a method."""


class Colours(NamedTuple):
    """Harmonics along world directions, (N, 3) and (N, 3, 15), how near they are in words, and errors by splat if known."""

    dc: Tensor
    rest: Tensor
    words: str
    residual: Tensor | None = None


def export_pose(settings: ExportOptions, name: str, progress: Progress) -> Findings:
    """Write an avatar in one pose in a format of `FORMATS`, read it back, and compare.

    Raises `InputError` for a folder that holds no avatar of splats, and for a timestep that the capture lacks;
    `UnavailableError` where the format's library is not installed.
    """
    folder, out = avatar_folder(Path(settings.avatar)), Path(settings.out)
    check_writable(out, "--out")
    form = FORMATS[name]
    form.check()
    avatar = read_splat_avatar(folder)
    pose = _pose(settings, read_shared_head(folder), progress)
    splats = avatar.splats(pose)
    colours = harmonics_of(avatar, pose, settings.directions)
    form.write(out, StoredSplats.of(splats, colours.dc, colours.rest))
    lost = _least_psnr(avatar, pose, form.read(out))
    data = {"out": out, "splats": len(splats.means), "timestep": pose.timestep}
    data |= {"bytes": out.stat().st_size, "psnr": lost}
    off = ""
    if colours.residual is not None:
        # Splats that hardly show would hide how far off those are that do.
        weight = splats.opacities / max(float(splats.opacities.sum()), 1e-12)
        residual = colours.residual
        data["residual_rms"] = float(np.sqrt((weight * residual.numpy() ** 2).sum()))
        data["residual_p95"] = float(torch.quantile(residual, 0.95)) if len(residual) else 0.0
        off = f", off by {data['residual_rms']:.4f} (rms), {data['residual_p95']:.4f} (95 % of splats)"
    text = f"{out}: {len(splats.means)} splats, {out.stat().st_size / 1e6:.2f} MB; {colours.words}{off};"
    return Findings(f"{text} PSNR against the avatar's own frames {lost:.1f} dB or more", data)


def harmonics_of(avatar: SplatMethodAvatar, pose: HeadPose, directions: int) -> Colours:
    """Colours of a pose as spherical harmonics of degree 3, exactly or as near as they come."""
    if isinstance(avatar, GAAvatar):
        return Colours(*avatar.harmonics(), "its own spherical harmonics, exactly")
    if isinstance(avatar, GBSAvatar):
        turned = turn_harmonics(*avatar.harmonics(pose))
        return Colours(*turned, "its spherical harmonics in this pose, turned with the surface")
    if isinstance(avatar, GHAAvatar):
        colors = avatar.splats(pose, look(0.0, 0.0, 1.0, np.zeros(3), SIZE)).colors
        assert colors is not None
        dc = torch.from_numpy((colors - 0.5) / C0)
        return Colours(dc, dc.new_zeros(len(dc), 3, 15), PLAIN)
    seen_from = avatar.seen_from(pose)
    fit = fit_harmonics(seen_from.radiance, seen_from.normals, sphere(directions))
    return Colours(fit.dc, fit.rest, "harmonics fitted to the planes' colours", fit.residual)


def _least_psnr(avatar: SplatMethodAvatar, pose: HeadPose, found: StoredSplats) -> float:
    """dB, the least of `VIEWS`: the file's splats drawn by our renderer against the avatar's frames, on white."""
    source = Source(avatar, pose, np.zeros(3), np.zeros((4, 3)))
    extent = np.quantile(source.seen(pose).means, (0.005, 0.995), axis=0)
    distance = float((extent[1] - extent[0]).max()) / np.tan(np.radians(FIELD_OF_VIEW))
    worst = np.inf
    for azimuth, elevation in VIEWS:
        camera = source.camera(look(azimuth, elevation, 1.5 * distance, extent.mean(axis=0), SIZE))
        along = torch.nn.functional.normalize(found.means - torch.from_numpy(camera.center).float(), dim=1)
        harmonics = torch.cat([found.dc[:, :, None], found.rest], dim=2)
        colors = torch.relu(0.5 + (harmonics * sh_basis(along, DEGREE)[:, None]).sum(2))
        motion, K = (torch.from_numpy(np.asarray(m, np.float32)) for m in (camera.world_to_camera, camera.K))
        drawn = rasterize(
            *(found.means, found.quats, found.scales, found.opacities, colors),
            *(motion, K, camera.width, camera.height),
            background=torch.ones(3),
        )
        error = float(np.square(drawn.image.clamp(0, 1).numpy() - avatar.render(camera, pose).rgb).mean())
        worst = min(worst, -10 * float(np.log10(max(error, 1e-12))))
    return worst


def stored_kind(folder: Path) -> str:
    """Name of the native method whose avatar lies in a folder, by its files; "" for any other."""
    if (folder / PLY_FILE).exists():
        return "ga"
    if (folder / COMPACT_FILE).exists():
        return "ours"
    path = folder / FIELD_FILE
    names = set(read_safetensors(path)[0]) if path.exists() else set()
    if names:
        return "gbs" if "differences" in names else "gha" if "table" in names else "ours"
    return "insta" if (folder / RADIANCE_FILE).exists() else ""


def read_splat_avatar(folder: Path, methods: Sequence[str] = tuple(AVATARS)) -> SplatMethodAvatar:
    """Read an avatar by what lies in its folder. Raises `InputError` for one of another method than ``methods``."""
    kind, names = stored_kind(folder), list(methods)
    expected = f"an avatar of {', '.join(names[:-1])} or {names[-1]}"
    if not kind:
        files = f"{expected}: {PLY_FILE}, {FIELD_FILE} or {COMPACT_FILE}"
        remedy = "The avatars of a run lie in SUBJECT/METHOD/seed-N/avatar inside its folder."
        is_run = (folder / "run.json").exists()
        raise InputError(folder, "", files, "none of them", remedy if is_run else "")
    if kind not in names:
        found, remedy = f"one of {kind}, {NOT_HELD[kind]}", "`headbench view` and `headbench render` show it."
        raise InputError(folder, "", expected, found, remedy)
    if kind == "ga":
        foreign = [name for name in read_names(folder / PLY_FILE) if name not in COLUMNS]
        if foreign:
            found = "a column of another method, which would be lost"
            raise InputError(folder / PLY_FILE, foreign[0], expected, found)
    return AVATARS[kind].read(folder, "cpu")


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
