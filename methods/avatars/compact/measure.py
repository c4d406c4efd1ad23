"""Store an avatar compactly, and measure the loss of quality by part."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ....bench.contracts import ByteArray, Clip, HeadAsset, Progress, no_progress
from ....bench.engine.stored import avatar_digest, open_avatar, write_avatar_record
from ....bench.errors import InputError
from ....bench.io.images import quantise
from ....bench.protocol import evenly_with_ends
from ....bench.specs import CommandResult
from ...ours.avatar import OursAvatar
from ...ours.storage import StoredField
from ...shared.avatar_files import read_shared_head, save_shared_head
from ...shared.capacity import training_poses
from ...shared.losses import picture_ssim, psnr, squared_error
from ...shared.subject_mesh import SubjectMesh
from .container import Content, write_content
from .file import COMPACT_FILE, decode, encode, exact_sizes, part_sizes
from .precision import EXACT, Precision
from .settings import CompactSettings
from .simplify import simplify

SIMPLIFIED, WHOLE = "left out", "all"


def compact_avatar(settings: CompactSettings, progress: Progress = no_progress) -> CommandResult:
    """Store an avatar of the method "ours", and measure its size and quality; see the settings.

    Raises `InputError` for a folder without the exact file of an avatar of method "ours", and for the capture of
    another subject.
    """
    stored, out = open_avatar(Path(settings.avatar)), Path(settings.out)
    folder = stored.folder
    if not isinstance(stored.load(), OursAvatar):
        found = f"an avatar of {stored.record['method']}"
        raise InputError(folder, "", "the exact file of an avatar of method ours", found)
    exact = OursAvatar.read(folder, "cpu", exact=True)
    head = read_shared_head(folder)
    clip = None
    if settings.compare is not None:
        clip = settings.open(settings.compare, progress)
        if clip.subject != exact.subject.name:
            raise InputError(settings.compare, "subject", repr(exact.subject.name), repr(clip.subject))
    field = simplify(exact, [] if clip is None else training_poses(clip), settings.precision)
    content = encode(field, exact.subject, head, settings.precision)
    write_content(out / COMPACT_FILE, content)
    save_shared_head(out, head)
    shown = exact.subject.name, exact.subject.shape, head.version
    source = {"of": avatar_digest(folder), "precision": asdict(settings.precision)}
    write_avatar_record(out, stored.method, *shown, "compact", source)

    parts = {
        part: {"exact_bytes": size, "compact_bytes": part_sizes(content).get(part, 0)}
        for part, size in exact_sizes(exact.field, exact.subject).items()
    }
    whole = {
        "exact_bytes": sum(path.stat().st_size for path in exact.files()),
        "compact_bytes": (out / COMPACT_FILE).stat().st_size,
    }
    data: dict[str, Any] = {
        "file": out / COMPACT_FILE,
        "precision": settings.precision,
        "splats": len(exact.field.tensors["splats"]),
        "splats_kept": len(field.tensors["splats"]),
        "whole": whole,
        "parts": parts,
    }
    if clip is not None:
        comparison = Comparison(clip, exact, settings.frames, settings.scale)
        costs = _costs(field, exact, head, settings.precision, comparison, progress)
        data |= {"frames": len(comparison.keys), "exact": _plain(comparison.exact), "quality": costs}
    return CommandResult(_text(data), data)


def _costs(
    field: StoredField,
    exact: OursAvatar,
    head: HeadAsset,
    precision: Precision,
    comparison: Comparison,
    progress: Progress,
) -> dict[str, dict[str, float | None]]:
    """Quality with each part rounded alone, with all parts rounded, and with invisible splats removed only."""
    variants = {
        part.name: replace(EXACT, **{part.name: getattr(precision, part.name)}) for part in fields(precision)
    }
    variants = {name: variants[name] for name in exact_sizes(field, exact.subject) if name in variants}
    variants |= {SIMPLIFIED: EXACT, WHOLE: precision}
    result = {}
    for done, (name, variant) in enumerate(variants.items()):
        progress(done, len(variants), name)
        result[name] = _plain(comparison(avatar_of(encode(field, exact.subject, head, variant), head)))
    return result


def _plain(quality: Quality) -> dict[str, float | None]:
    """The value for JSON: None if it is not a number or infinite."""
    return {name: value if math.isfinite(value) else None for name, value in quality._asdict().items()}


def _text(data: Mapping[str, Any]) -> str:
    qualities, exact = data.get("quality", {}), data.get("exact")
    head = f"{'part':<12}{'exact':>12}{'compact':>12}"
    if exact:
        head += f"{'dB to truth':>14}{'SSIM to truth':>15}{'dB to exact':>13}"
    rows = [head]
    for part, sizes in data["parts"].items():
        rows.append(_row(part, sizes, qualities.get(part), exact))
    if exact:
        rows.append(_row(SIMPLIFIED, None, qualities[SIMPLIFIED], exact))
    rows.append(_row(WHOLE, data["whole"], qualities.get(WHOLE), exact))
    kept, count, whole = data["splats_kept"], data["splats"], data["whole"]
    rows.append(
        f"{data['file']}: {whole['compact_bytes'] / 1e6:.3f} MB, 1/{whole['exact_bytes'] / whole['compact_bytes']:.1f} "
        f"of the exact files; {kept} of {count} splats, {whole['compact_bytes'] / max(kept, 1):.1f} bytes for each"
    )
    if exact:
        rows.append(
            f"Quality on {data['frames']} held-out frames, each part rounded alone. Left out: what no training pose "
            "shows, nothing rounded."
        )
        if exact["psnr"] is not None:
            rows.append(
                f"Exact avatar: {exact['psnr']:.3f} dB, SSIM {exact['ssim']:.5f}; above are the differences."
            )
    return "\n".join(rows)


def _row(
    part: str,
    sizes: Mapping[str, int] | None,
    quality: Mapping[str, float | None] | None,
    exact: Mapping[str, float | None] | None,
) -> str:
    row = f"{part:<12}"
    row += f"{'':>24}" if sizes is None else f"{sizes['exact_bytes']:>12,}{sizes['compact_bytes']:>12,}"
    if quality is None or exact is None:
        return row.rstrip()
    against = [f"{'':>14}", f"{'':>15}"]
    if quality["psnr"] is not None and exact["psnr"] is not None:
        against[0] = f"{quality['psnr'] - exact['psnr']:>+14.3f}"
    if quality["ssim"] is not None and exact["ssim"] is not None:
        against[1] = f"{quality['ssim'] - exact['ssim']:>+15.5f}"
    to_exact = quality["psnr_exact"]
    return row + "".join(against) + (f"{'equal':>13}" if to_exact is None else f"{to_exact:>13.2f}")


class Quality(NamedTuple):
    """Quality of an avatar's renders."""

    psnr: float
    """dB against the ground truth, mean over frames; NaN without one."""
    ssim: float
    """SSIM against the ground truth, mean over frames, with the window used in training."""
    psnr_exact: float
    """dB against the renders of the exact avatar, from the mean squared error over all frames; infinite if equal."""


class Comparison:
    """Held-out frames of a clip: renders of the exact avatar, and ground truth.

    Parameters
    ----------
    frames : int
        Number of frames, spread evenly over both held-out splits.
    scale : int
        Enlargement of the renders; above 1 there is no ground truth.
    """

    def __init__(self, clip: Clip, exact: OursAvatar, frames: int, scale: int = 1):
        self._clip, self._scale = clip, scale
        keys = [*clip.splits["novel_view"], *clip.splits["self_reenactment"]]
        self.keys = evenly_with_ends(keys, frames)
        self._truth = [clip.image(key) for key in self.keys] if scale == 1 else None
        self._exact = self._pictures(exact)
        self.exact = self._quality(self._exact)

    def __call__(self, avatar: OursAvatar) -> Quality:
        """Quality of another avatar on the same frames."""
        return self._quality(self._pictures(avatar))

    def _pictures(self, avatar: OursAvatar) -> list[ByteArray]:
        clip, scale, pictures = self._clip, self._scale, []
        background = tuple(float(channel) for channel in clip.background)
        for key in self.keys:
            camera = clip.cameras[key.camera]
            camera = camera.resized(scale * camera.width, scale * camera.height)
            pictures.append(quantise(avatar.render(camera, clip.poses[key.timestep], background).rgb))
        return pictures

    def _quality(self, pictures: Sequence[ByteArray]) -> Quality:
        against_exact = psnr(float(np.mean([squared_error(a, b) for a, b in zip(pictures, self._exact)])))
        if self._truth is None:
            return Quality(math.nan, math.nan, against_exact)
        pairs = list(zip(pictures, self._truth))
        decibels = [psnr(squared_error(*pair)) for pair in pairs]
        similarity = [picture_ssim(*pair) for pair in pairs]
        return Quality(float(np.mean(decibels)), float(np.mean(similarity)), against_exact)


def avatar_of(content: Content, head: HeadAsset) -> OursAvatar:
    """The avatar decoded from the content of a compact file."""
    subject, field = decode(Path(COMPACT_FILE), content, head, "cpu")
    mesh = SubjectMesh(head, subject.shape, subject.static_offset, "cpu")
    return OursAvatar([], mesh, subject, field, "cpu")
