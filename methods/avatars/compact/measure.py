"""Store an avatar through the codec, and measure the loss of quality by part."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from ....bench.contracts import Avatar, ByteArray, Clip, Progress, SplatAvatar, no_progress
from ....bench.engine.adaptation import AdaptedClip, MethodNeeds, apply, plan
from ....bench.engine.stored import avatar_digest, open_avatar, write_avatar_record
from ....bench.errors import InputError
from ....bench.io.images import quantise
from ....bench.protocol import evenly_with_ends
from ....bench.specs import CommandResult
from ...shared.avatar_files import COMPACT_FILE, read_shared_head
from ...shared.losses import picture_ssim, psnr, squared_error
from ..export import neutral_pose
from .codecs import DRIVING_FILE, ENCODERS, write_coded
from .precision import EXACT
from .settings import CompactSettings

WHOLE = "all"


def compact_avatar(settings: CompactSettings, progress: Progress = no_progress) -> CommandResult:
    """Store an avatar of a native method through the codec, and measure its size and quality; see the settings.

    Raises `InputError` for a folder without the files of a training, and for the capture of another subject.
    """
    stored, out = open_avatar(Path(settings.avatar)), Path(settings.out)
    folder = stored.folder
    exact = stored.load()
    if type(exact) not in ENCODERS or any(path.name == COMPACT_FILE for path in exact.files()):
        found = f"an avatar of {stored.record['method']}"
        raise InputError(folder, "", "the files of a trained avatar of a native method", found)
    head = read_shared_head(folder)
    with TemporaryDirectory() as scratch:
        form = None
        if settings.compare is not None:
            clip = settings.open(settings.compare, progress)
            if clip.subject != stored.record["subject"]:
                raise InputError(
                    settings.compare, "subject", repr(stored.record["subject"]), repr(clip.subject)
                )
            needs = MethodNeeds.of(stored.method.spec)
            step = plan(clip, needs, stored.heads)
            kept = Path(scratch) / "adapted"
            form = AdaptedClip(clip) if step is None else apply(step, needs, kept, f"adapting {clip.subject}")
            comparison = Comparison(clip, form, exact, settings.frames, settings.scale)
        own = None if form is None else form.clip
        parts = write_coded(exact, head, out, settings.precision, own, folder / DRIVING_FILE)
        record = stored.record
        source = {"of": avatar_digest(folder), "precision": asdict(settings.precision)}
        shown = record["subject"], record["shape"], record["head_model"]
        write_avatar_record(out, stored.method, *shown, "compact", source)
        whole = {
            "exact_bytes": sum(path.stat().st_size for path in exact.files()),
            "compact_bytes": (out / COMPACT_FILE).stat().st_size,
        }
        data: dict[str, Any] = {"file": out / COMPACT_FILE, "precision": settings.precision}
        if isinstance(exact, SplatAvatar):
            data["splats"] = len(exact.splats(neutral_pose(head)).means)
        data |= {"whole": whole, "parts": {part: {"compact_bytes": size} for part, size in parts.items()}}
        if own is not None:
            precision, quality = settings.precision.scaled, {}
            variants = {
                n: replace(EXACT, **{n: getattr(precision, n)}) for n in precision.parts if n in parts
            }
            for done, (name, variant) in enumerate([*variants.items(), (WHOLE, precision)]):
                progress(done, len(variants) + 1, name)
                coded = Path(scratch) / "coded"
                write_coded(exact, head, coded, variant, own, folder / DRIVING_FILE)
                quality[name] = _plain(comparison(stored.method.create().load(coded, device="cpu")))
            data |= {"frames": len(comparison.keys), "exact": _plain(comparison.exact), "quality": quality}
    return CommandResult(_text(data), data)


def _plain(quality: Quality) -> dict[str, float | None]:
    """The value for JSON: None if it is not a number or infinite."""
    return {name: value if math.isfinite(value) else None for name, value in quality._asdict().items()}


def _text(data: Mapping[str, Any]) -> str:
    qualities, exact, whole = data.get("quality", {}), data.get("exact"), data["whole"]
    head = f"{'part':<12}{'exact':>12}{'coded':>12}"
    if exact:
        head += f"{'dB to truth':>14}{'SSIM to truth':>15}{'dB to exact':>13}"
    rows = [head]
    rows += [_row(part, sizes, qualities.get(part), exact) for part, sizes in data["parts"].items()]
    rows.append(_row(WHOLE, whole, qualities.get(WHOLE), exact))
    ratio = whole["exact_bytes"] / whole["compact_bytes"]
    line = f"{data['file']}: {whole['compact_bytes'] / 1e6:.3f} MB, 1/{ratio:.1f} of the exact files"
    if count := data.get("splats"):
        line += f"; {count} splats, {whole['compact_bytes'] / count:.1f} bytes for each"
    rows.append(line)
    if exact:
        rows.append(f"Quality on {data['frames']} held-out frames with only one part quantised.")
        if exact["psnr"] is not None:
            rows.append(
                f"Exact avatar: {exact['psnr']:.3f} dB, SSIM {exact['ssim']:.5f}; the table has differences from it."
            )
    return "\n".join(rows)


def _row(
    part: str,
    sizes: Mapping[str, int],
    quality: Mapping[str, float | None] | None,
    exact: Mapping[str, float | None] | None,
) -> str:
    row = f"{part:<12}"
    for name in ("exact_bytes", "compact_bytes"):
        row += f"{sizes[name]:>12,}" if name in sizes else f"{'':>12}"
    if quality is None or exact is None:
        return row.rstrip()
    for name, text in (("psnr", "+14.3f"), ("ssim", "+15.5f")):
        value, reference = quality[name], exact[name]
        known = value is not None and reference is not None
        row += format(value - reference, f">{text}") if known else " " * int(text[1:3])
    to_exact = quality["psnr_exact"]
    return row + ("equal" if to_exact is None else f"{to_exact:.2f}").rjust(13)


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
    form : AdaptedClip
        The clip adapted to the method, whose poses animate the avatar.
    frames : int
        Number of frames, spread evenly over both held-out splits.
    scale : int
        Enlargement of the renders; above 1 there is no ground truth.
    """

    def __init__(self, clip: Clip, form: AdaptedClip, exact: Avatar, frames: int, scale: int = 1):
        self._clip, self._form, self._scale = clip, form, scale
        keys = [*clip.splits["novel_view"], *clip.splits["self_reenactment"]]
        self.keys = evenly_with_ends(keys, frames)
        self._truth = [clip.image(key) for key in self.keys] if scale == 1 else None
        self._exact = self._pictures(exact)
        self.exact = self._quality(self._exact)

    def __call__(self, avatar: Avatar) -> Quality:
        """Quality of another avatar on the same frames."""
        return self._quality(self._pictures(avatar))

    def _pictures(self, avatar: Avatar) -> list[ByteArray]:
        clip, scale, pictures = self._form.clip, self._scale, []
        background = tuple(float(channel) for channel in clip.background)
        for key in self.keys:
            seen = self._form.key(key)
            camera = clip.cameras[seen.camera]
            if scale > 1:
                camera = camera.resized(scale * camera.width, scale * camera.height)
            rgb = avatar.render(camera, clip.poses[seen.timestep], background).rgb
            pictures.append(quantise(self._form.restore(key, rgb) if scale == 1 else rgb))
        return pictures

    def _quality(self, pictures: Sequence[ByteArray]) -> Quality:
        against_exact = psnr(float(np.mean([squared_error(a, b) for a, b in zip(pictures, self._exact)])))
        if self._truth is None:
            return Quality(math.nan, math.nan, against_exact)
        pairs = list(zip(pictures, self._truth))
        decibels = [psnr(squared_error(*pair)) for pair in pairs]
        similarity = [picture_ssim(*pair) for pair in pairs]
        return Quality(float(np.mean(decibels)), float(np.mean(similarity)), against_exact)
