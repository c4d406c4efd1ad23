"""Export of avatars in one pose as splat files for viewers, their formats, and the loss of quality."""

from __future__ import annotations

import importlib
import io
import json
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import FloatArray, HeadAsset, HeadPose, Progress, SplatAvatar, Splats, no_progress
from ...bench.engine.stored import StoredAvatar, open_avatar
from ...bench.errors import HeadbenchError, InputError, UnavailableError, install_extra
from ...bench.io.files import check_writable, read_bytes, write_bytes
from ...bench.io.provenance import RENDER, note, tool
from ...bench.specs import CommandResult, command
from ..ga.method import COLUMNS
from ..ops.planes import C0, harmonic_colors
from ..shared.avatar_files import read_shared_head
from ..shared.rendering import view_of
from ..shared.tensor_files import read_ply, write_ply
from ..splats import rasterize
from .glb import Glb, GlbWriter
from .harmonics import DEGREE, FIELD_OF_VIEW, direction_of, extent, harmonics_of, orbit_camera
from .settings import AvatarOptions, ExportGlbSettings, ExportOptions, ExportPlySettings, ExportSogSettings
from .web.bake import Source

STANDARD = COLUMNS[:-1]
"""62 float32: position, zero normals, harmonics (the rest channel by channel), opacity logit, log-scales, wxyz."""
OPACITY_MARGIN = 1e-6  # logits stay finite


class StoredSplats(NamedTuple):
    """Splats in world space, float32: (N, 3) means, (N, 4) quaternions wxyz, (N, 3) scales, (N,) opacities, and
    harmonics along world directions, (N, 3) and (N, 3, 15)."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    dc: Tensor
    rest: Tensor

    @classmethod
    def of(cls, posed: Splats, dc: Tensor, rest: Tensor) -> StoredSplats:
        """Splats of an avatar with their harmonics; missing degrees are zero."""
        every = torch.zeros(len(dc), 3, 15)
        every[:, :, : rest.shape[2]] = rest
        means, quats, scales, opacities = (
            torch.from_numpy(np.asarray(values, np.float32))
            for values in (posed.means, posed.quats, posed.scales, posed.opacities)
        )
        return cls(means, quats, scales, opacities, dc.float().cpu(), every)


class Format(NamedTuple):
    """Writer and reader of a format; ``check`` raises `UnavailableError` if a dependency is missing."""

    check: Callable[[], Any]
    write: Callable[[Path, StoredSplats], None]
    read: Callable[[Path], StoredSplats]


# ------------------------------------------------------------------ PLY


def _write_ply(path: Path, splats: StoredSplats) -> None:
    opacities = splats.opacities.numpy().astype(np.float64).clip(OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    columns: list[FloatArray] = [
        splats.means.numpy(),
        np.zeros_like(splats.means.numpy()),
        splats.dc.numpy(),
        splats.rest.flatten(1).numpy(),
        np.log(opacities / (1 - opacities))[:, None],
        np.log(np.maximum(splats.scales.numpy(), np.finfo(np.float32).tiny)),
        splats.quats.numpy(),
    ]
    write_ply(path, STANDARD, np.concatenate(columns, axis=1).astype(np.float32), note(RENDER))


def _read_ply(path: Path) -> StoredSplats:
    table = torch.from_numpy(read_ply(path, STANDARD))
    return StoredSplats(
        table[:, :3].contiguous(),
        table[:, 58:].contiguous(),
        table[:, 55:58].exp(),
        torch.sigmoid(table[:, 54]),
        table[:, 6:9].contiguous(),
        table[:, 9:54].reshape(-1, 3, 15),
    )


# ------------------------------------------------------------------ glTF

EXTENSION = "KHR_gaussian_splatting"
"""Khronos, extensions/2.0/Khronos/KHR_gaussian_splatting: linear scales, opacities from 0 to 1, quaternions xyzw."""
POINTS = 0
HARMONICS = [(degree, number) for degree in range(4) for number in range(2 * degree + 1)]


def _write_glb(path: Path, splats: StoredSplats) -> None:
    harmonics = torch.cat([splats.dc[:, :, None], splats.rest], dim=2)
    plain = (0.5 + C0 * splats.dc).clamp(0, 1)
    # Points for viewers without support for splats; linear, as glTF's colours are.
    linear = torch.where(plain <= 0.04045, plain / 12.92, ((plain + 0.055) / 1.055) ** 2.4)
    attributes = {
        "POSITION": splats.means,
        "COLOR_0": torch.cat([linear, splats.opacities[:, None]], dim=1),
        f"{EXTENSION}:ROTATION": torch.nn.functional.normalize(splats.quats[:, [1, 2, 3, 0]], dim=1),
        f"{EXTENSION}:SCALE": splats.scales,
        f"{EXTENSION}:OPACITY": splats.opacities,
        **{
            f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{number}": harmonics[:, :, index]
            for index, (degree, number) in enumerate(HARMONICS)
        },
    }
    writer = GlbWriter()
    numbers = {
        name: writer.add(values.numpy(), bounds=name == "POSITION") for name, values in attributes.items()
    }
    extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"attributes": numbers, "mode": POINTS, "extensions": {EXTENSION: extension}}
    scene = {
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
    }
    writer.write(path, scene)


def _read_glb(path: Path) -> StoredSplats:
    """Read what `_write_glb` wrote."""
    content = Glb.read(path)
    (primitive,) = content.header["meshes"][0]["primitives"]
    columns = {
        name.removeprefix(f"{EXTENSION}:"): torch.from_numpy(content.array(number).copy())
        for name, number in primitive["attributes"].items()
    }
    harmonics = [columns[f"SH_DEGREE_{degree}_COEF_{number}"] for degree, number in HARMONICS]
    return StoredSplats(
        *(columns["POSITION"], columns["ROTATION"][:, [3, 0, 1, 2]].contiguous()),
        *(columns["SCALE"], columns["OPACITY"]),
        *(harmonics[0], torch.stack(harmonics[1:], dim=2)),
    )


# ------------------------------------------------------------------ SOG


def _library() -> Any:
    try:
        return importlib.import_module("gaussforge").GaussForge()
    except ImportError:
        raise UnavailableError(
            "SOG is written by gaussforge, which is not installed.", install_extra("formats")
        ) from None


def _converted(content: bytes, source: str, target: str) -> bytes:
    result = _library().convert(content, source, target)
    if "error" in result:
        raise HeadbenchError(f"gaussforge could not turn {source} into {target}: {result['error']}")
    return bytes(result["data"])


def _write_sog(path: Path, splats: StoredSplats) -> None:
    with tempfile.TemporaryDirectory() as folder:
        ply = Path(folder) / "splats.ply"
        _write_ply(ply, splats)
        write_bytes(path, _marked(_converted(ply.read_bytes(), "ply", "sog")))


def _marked(content: bytes) -> bytes:
    """The archive with headbench and the digital source type in its meta.json."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as source, zipfile.ZipFile(out, "w") as target:
        for name in source.namelist():
            member = source.read(name)
            if name == "meta.json":
                meta = json.loads(member)
                meta["asset"] = {"generator": f"{tool()}, GaussForge", "note": note(RENDER)}
                member = json.dumps(meta, separators=(",", ":")).encode()
            # A fixed time makes files of equal avatars equal.
            target.writestr(zipfile.ZipInfo(name), member)
    return out.getvalue()


def _read_sog(path: Path) -> StoredSplats:
    with tempfile.TemporaryDirectory() as folder:
        ply = Path(folder) / "splats.ply"
        ply.write_bytes(_converted(read_bytes(path, "a SOG file"), "sog", "ply"))
        return _read_ply(ply)


FORMATS = {
    "ply": Format(lambda: None, _write_ply, _read_ply),
    "glb": Format(lambda: None, _write_glb, _read_glb),
    "sog": Format(_library, _write_sog, _read_sog),
}


VIEWS = ((0.0, 0.0), (0.6, 0.0), (-0.6, 0.2))
"""Azimuth and elevation, radians, of the views in which the loss is measured."""
SIZE = 400


def open_splats(settings: AvatarOptions) -> tuple[StoredAvatar, SplatAvatar]:
    """The stored avatar named by a command, and the loaded avatar."""
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
    low, high = extent(source.seen(pose).means)
    distance = float((high - low).max()) / np.tan(np.radians(FIELD_OF_VIEW))
    worst = np.inf
    for azimuth, elevation in VIEWS:
        camera = source.camera(
            orbit_camera(direction_of(azimuth, elevation), 1.5 * distance, (low + high) / 2, SIZE)
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
