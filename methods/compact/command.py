"""``headbench compact``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from ...bench.contracts import Clip, HeadAsset, Progress, no_progress
from ...bench.errors import InputError
from ...bench.specs import Findings, writes
from ...datasets.options import CaptureOptions
from .precision import EXACT, Precision

if TYPE_CHECKING:
    from ..ours.avatar import OursAvatar
    from ..ours.storage import Field
    from .measure import Comparison, Quality


@dataclass(frozen=True)
class CompactSettings(CaptureOptions):
    """Store an avatar of ours in about a fifteenth of its bytes."""

    avatar: tyro.conf.Positional[str]
    """Folder of the avatar, with its exact file."""

    out: str
    """Folder to write: the compact file, and the head model beside it."""

    compare: str | None = None
    """Capture that the avatar was trained on. Splats that none of its training poses shows are left out, and the
    quality is measured on its held-out frames."""

    frames: int = 8
    """Held-out frames to compare on, evenly spread over both held-out splits."""

    scale: int = 1
    """Enlarge the compared images so many times. Above 1 there is no ground truth to compare with, only the exact
    avatar."""

    precision: Precision = field(default_factory=Precision)
    """How finely each part is stored."""

    def __post_init__(self) -> None:
        if self.frames < 1 or self.scale < 1:
            raise ValueError(f"frames and scale must be at least 1, found {self.frames} and {self.scale}")


SIMPLIFIED, WHOLE = "left out", "all"


@writes("out")
def compact(settings: CompactSettings, progress: Progress = no_progress) -> Findings:
    """Store an avatar of ours in about a fifteenth of its bytes; with a capture, measure the cost in quality.

    With a capture, each part's cost in quality is measured alone.

    Raises `InputError` for a folder without the exact file of an avatar of ours, and for the capture of another
    subject.
    """
    from ..ours.avatar import OursAvatar
    from ..ours.storage import FIELD_FILE
    from ..shared.avatar_files import read_shared_head, save_shared_head
    from .container import write_content
    from .file import COMPACT_FILE, encode, exact_sizes, part_sizes
    from .measure import Comparison
    from .simplify import simplify, training_poses

    folder, out = Path(settings.avatar), Path(settings.out)
    if not (folder / FIELD_FILE).exists():
        raise InputError(folder, FIELD_FILE, "the exact file of an avatar of ours", "none")
    exact = OursAvatar.read(folder, "cpu", exact=True)
    head = read_shared_head(folder)
    clip = _clip(settings, exact.subject.name, progress)
    field = simplify(exact, [] if clip is None else training_poses(clip), settings.precision)
    content = encode(field, exact.subject, head, settings.precision)
    write_content(out / COMPACT_FILE, content)
    save_shared_head(out, head)

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
    return Findings(_text(data), data)


def _clip(settings: CompactSettings, subject: str, progress: Progress) -> Clip | None:
    if settings.compare is None:
        return None
    clip = settings.open(settings.compare, progress)
    if clip.subject != subject:
        raise InputError(settings.compare, "subject", repr(subject), repr(clip.subject))
    return clip


def _costs(
    field: Field,
    exact: OursAvatar,
    head: HeadAsset,
    precision: Precision,
    comparison: Comparison,
    progress: Progress,
) -> dict[str, dict[str, float | None]]:
    """Quality with one part rounded alone, by part; with all; and with none, only what no pose shows left out."""
    from .file import encode, exact_sizes
    from .measure import avatar_of

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
    """As JSON knows it: None for what is not a number or infinite."""
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
