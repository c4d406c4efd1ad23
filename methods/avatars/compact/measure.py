"""Store an avatar through the codec, and measure the loss of quality by part."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ....bench.contracts import Avatar, ByteArray, Clip, Progress, SplatAvatar, no_progress
from ....bench.engine.adaptation import AdaptedClip, MethodNeeds, apply, plan
from ....bench.engine.stored import avatar_digest, open_avatar, write_avatar_record
from ....bench.errors import InputError
from ....bench.io.images import quantise
from ....bench.protocol import evenly_with_ends
from ....bench.specs import CommandResult, command
from ...shared.avatar_files import COMPACT_FILE, read_shared_head
from ...shared.optimisation import picture_ssim, psnr, squared_error
from ..export import neutral_pose
from ..settings import EXACT, CompactSettings
from .codecs import DRIVING_FILE, parts_of, write_coded

Quality = dict[str, float | None]
"""PSNR (dB) and SSIM against the ground truth, means over frames, None without one; and ``psnr_exact``, dB against the renders
of the exact avatar, from the mean squared error over all frames, None if they are equal."""
WHOLE = "all"


@command("export compact", group="export", writes="out", kinds=("an avatar",))
def compact_avatar(settings: CompactSettings, progress: Progress = no_progress) -> CommandResult:
    """Store an avatar of a native method by the common codec, at a tenth of its size or less.

    Raises `InputError` for a folder without the files of a training, and for the capture of another subject.
    """
    stored, out = open_avatar(Path(settings.avatar)), Path(settings.out)
    folder, exact = stored.folder, stored.load()
    head, driving = read_shared_head(folder), folder / DRIVING_FILE
    with TemporaryDirectory() as scratch:
        form = None
        if settings.compare is not None:
            clip, subject = settings.open(settings.compare, progress), stored.record["subject"]
            if clip.subject != subject:
                raise InputError(settings.compare, "subject", repr(subject), repr(clip.subject))
            needs, kept = MethodNeeds.of(stored.method.spec), Path(scratch) / "adapted"
            step = plan(clip, needs, stored.heads)
            form = AdaptedClip(clip) if step is None else apply(step, needs, kept, f"adapting {clip.subject}")
            comparison = Comparison(clip, form, exact, settings.frames, settings.scale)
        own = None if form is None else form.clip
        prepared = parts_of(exact, head, own)
        parts = write_coded(prepared, head, out, settings.precision, driving)
        source = {"of": avatar_digest(folder), "precision": asdict(settings.precision)}
        record = stored.record
        identity = record["subject"], record["shape"], record["head_model"]
        write_avatar_record(out, stored.method, *identity, "compact", source)
        size = sum(path.stat().st_size for path in exact.files())
        data: dict[str, Any] = {"file": out / COMPACT_FILE, "precision": settings.precision}
        if isinstance(exact, SplatAvatar):
            data["splats"] = len(exact.splats(neutral_pose(head)).means)
        data["whole"] = {"exact_bytes": size, "compact_bytes": (out / COMPACT_FILE).stat().st_size}
        data["parts"] = {part: {"compact_bytes": size} for part, size in parts.items()}
        if own is not None:
            steps = {name: step for name, step in settings.precision.scaled.parts.items() if name in parts}
            variants = {name: replace(EXACT, **{name: step}) for name, step in steps.items()}
            quality = {}
            for done, (name, variant) in enumerate([*variants.items(), (WHOLE, settings.precision)]):
                progress(done, len(variants) + 1, name)
                write_coded(prepared, head, Path(scratch) / "coded", variant, driving)
                coded: Avatar = stored.method.create().load(Path(scratch) / "coded", device="cpu")
                quality[name] = comparison(coded)
            data |= {"frames": len(comparison.keys), "exact": comparison.exact, "quality": quality}
    return CommandResult(_text(data), data)


def _text(data: Mapping[str, Any]) -> str:
    exact, whole = data.get("exact"), data["whole"]
    columns = f"{'dB to truth':>14}{'SSIM to truth':>15}{'dB to exact':>13}" if exact else ""
    rows = [f"{'part':<12}{'bytes':>12}{columns}"]
    for part, sizes in {**data["parts"], WHOLE: whole}.items():
        rows.append(f"{part:<12}{sizes['compact_bytes']:>12,}")
        quality = data.get("quality", {}).get(part)
        if exact and quality:
            for name, width, digits in (("psnr", 14, 3), ("ssim", 15, 5)):
                change = "" if exact[name] is None else f"{quality[name] - exact[name]:+.{digits}f}"
                rows[-1] += f"{change:>{width}}"
            to_exact = quality["psnr_exact"]
            rows[-1] += f"{'equal' if to_exact is None else f'{to_exact:.2f}':>13}"
    ratio = whole["exact_bytes"] / whole["compact_bytes"]
    rows.append(f"{data['file']}: {whole['compact_bytes'] / 1e6:.3f} MB, 1/{ratio:.1f} of the exact files")
    if count := data.get("splats"):
        rows[-1] += f"; {count} splats, {whole['compact_bytes'] / count:.1f} bytes for each"
    if exact:
        rows.append(
            f"Quality on {data['frames']} held-out frames with only one part quantised, less that of the exact avatar."
        )
    return "\n".join(rows)


class Comparison:
    """Renders of the exact avatar and ground truth of a number of held-out ``frames``, spread evenly over both splits. ``form`` is
    the clip adapted to the method; with an enlargement by ``scale`` above 1 there is no ground truth."""

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
        to_exact = psnr(float(np.mean([squared_error(a, b) for a, b in zip(pictures, self._exact)])))
        quality: Quality = {"psnr": None, "ssim": None, "psnr_exact": to_exact}
        if self._truth is not None:
            pairs = list(zip(pictures, self._truth))
            quality["psnr"] = float(np.mean([psnr(squared_error(*pair)) for pair in pairs]))
            quality["ssim"] = float(np.mean([picture_ssim(*pair) for pair in pairs]))
        return {
            name: value if value is None or math.isfinite(value) else None for name, value in quality.items()
        }
