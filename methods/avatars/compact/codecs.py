"""Encoding of avatars of all native methods: the tensors of each, and their visibility in training views.

All methods share the file, the coder and the steps (`Precision`); they differ only in their layouts.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from ....bench.contracts import (
    Avatar,
    ByteArray,
    Clip,
    FloatArray,
    HeadAsset,
    Progress,
    SplatAvatar,
    no_progress,
)
from ....bench.engine.adaptation import AdaptedClip, MethodNeeds, adapt
from ....bench.engine.stored import avatar_digest, open_avatar, write_avatar_record
from ....bench.errors import InputError
from ....bench.io.arrays import read_npz
from ....bench.io.documents import read_json
from ....bench.io.files import digest
from ....bench.io.images import quantise
from ....bench.protocol import evenly_with_ends
from ....bench.specs import CommandResult, command
from ...flashavatar.method import FlashAvatarAvatar
from ...flashavatar.model import gaussian_shapes
from ...ga.method import GAAvatar
from ...gbs.blendshapes import EXPRESSIONS
from ...gbs.method import GBSAvatar
from ...gha.gaussian_head import POINTS
from ...gha.method import CONFIG, TABLE, GHAAvatar
from ...insta.avatar import FIELD_FILE, SETTINGS, SETTINGS_FILE, InstaAvatar
from ...ops.planes import sh_basis, sh_degree
from ...ours.field import DYNAMIC, PER_SPLAT, splat_columns
from ...ours.method import OursAvatar
from ...rgbavatar.method import RGBAvatarAvatar
from ...rgbavatar.model import SHAPES, blend_weights
from ...shared.avatar_files import (
    AVATAR_FILE,
    COMPACT_FILE,
    SUBJECT_FILE,
    Subject,
    read_shared_head,
    read_subject,
    save_shared_head,
)
from ...shared.capacity import training_poses
from ...shared.optimisation import picture_ssim, psnr, squared_error, tracked_inputs
from ...shared.surface_points import point_tensors
from ...shared.surface_splats import SurfaceAvatar
from ...shared.tensor_files import read_safetensors
from ..export import neutral_pose
from ..harmonics import importance, training_views
from ..settings import EXACT, CompactSettings, Precision
from .coder import CODEC, Coder, CoderInput, Content, visibility_classes, write_content
from .layouts import (
    COLOURS,
    Layout,
    blended,
    bound,
    code_subject,
    field,
    field_metrics,
    grid,
    networks,
    offsets,
    reduced,
)

CODEC_VERSION = 4
"""Codec version, increased when the same avatar and steps give different files."""
DRIVING_FILE = "driving.npz"
"""Driving signal beside the avatars of some methods, which is not part of their size."""


class Parts(NamedTuple):
    """An avatar to encode: layout, source, subject and texts; splats in any order."""

    layout: Layout
    source: CoderInput
    subject: Subject
    text: Mapping[str, str] = {}


def parts_of(avatar: Avatar, head: HeadAsset, clip: Clip | None) -> Parts:
    """What `write_coded` encodes. With a clip, steps follow the visibility of each splat in its training views."""
    encoder, files = ENCODERS.get(type(avatar)), [*avatar.files()]
    if encoder is None or any(path.name == COMPACT_FILE for path in files):
        found = "a coded one" if encoder else f"a {type(avatar).__name__}"
        raise InputError(files[0], "", "a trained avatar of a native method that has a codec", found)
    return encoder(avatar, head, clip)


def write_coded(
    parts: Parts, head: HeadAsset, out: Path, precision: Precision, driving: Path | None
) -> dict[str, int]:
    """Write a coded avatar, its head model and, if there is one, the file of its ``driving`` signal into a folder.

    Returns the bytes of each part of `Precision`.
    """
    layout, source, subject, texts = parts
    person = {"shape": subject.shape, "static_offset": subject.static_offset}
    # A digest names individual steps that are not the defaults.
    digest_of = "" if precision.parts == Precision().parts else f" ({digest(precision.parts)[:8]})"
    codec = f"{CODEC_VERSION}, steps x{precision.step:g}{digest_of}"
    text = {"name": subject.name, "head_model": subject.head_model, **texts, CODEC: codec}
    coder = Coder(precision.scaled, text, replace(source, tensors={**source.tensors, **person}))
    layout(coder, head, code_subject(coder, head))
    assert not coder.left
    save_shared_head(out, head)
    if driving is not None and driving.is_file():
        shutil.copyfile(driving, out / DRIVING_FILE)
    sizes: dict[str, int] = {}
    written = write_content(out / COMPACT_FILE, Content(coder.arrays, text, precision.scaled.parts))
    for name, size in written.items():
        sizes[coder.parts[name]] = sizes.get(coder.parts[name], 0) + size
    return sizes


class _Splats:
    """Splats of an avatar in the order of the file: by class of visibility, since the values of a class are of similar range, and
    by triangle. ``rows`` are their indices."""

    def __init__(self, avatar: SplatAvatar, clip: Clip | None, triangles: np.ndarray):
        weights = None if clip is None else importance(avatar, training_views(clip))
        classes = visibility_classes(weights, len(triangles))
        self.rows = np.lexsort((triangles, classes))
        self._classes = classes[self.rows]
        self._weights = None if weights is None else weights[self.rows]

    def source(
        self, splats: Mapping[str, Any], others: Mapping[str, Any], metrics: Mapping[str, FloatArray]
    ) -> CoderInput:
        """Arrays or tensors with a row for each splat, and of others. Harmonics are joined."""
        arrays = {name: _numpy(value)[self.rows] for name, value in splats.items()}
        if "sh_dc" in arrays:
            dc, rest = arrays.pop("sh_dc"), arrays.pop("sh_rest")
            arrays[COLOURS] = np.concatenate([dc[:, :, None], rest], axis=2).reshape(len(dc), -1)
        arrays |= {name: _numpy(value) for name, value in others.items()} | {"classes": self._classes}
        return CoderInput(arrays, self._weights, metrics)


def _numpy(values: Tensor | np.ndarray) -> np.ndarray:
    return values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)


def _ours(avatar: OursAvatar, head: HeadAsset, clip: Clip | None) -> Parts:
    others = dict(avatar.field.tensors)
    splats = splat_columns(others.pop("splats"))
    splats |= {name: splats[name][:, 0] for name in ("opacities", "binding")}
    if "rotation" not in avatar.field.dynamic:  # which is added to quaternions of any length
        splats["quats"] = normalize(splats["quats"], dim=1)
    splats |= {name: others.pop(name) for name in PER_SPLAT if name in others}
    order = _Splats(avatar, clip, _numpy(splats["binding"]))
    source = order.source(splats, others, field_metrics(avatar.field.tensors))
    return Parts(field, source, avatar.subject, {DYNAMIC: ",".join(avatar.field.dynamic)})


def _ga(avatar: GAAvatar, head: HeadAsset, clip: Clip | None) -> Parts:
    metrics = {}
    if clip is not None:
        # Harmonics stay in the world. Errors count mostly along the directions from which static cameras see them in training;
        # a fifth of the weight is that of all directions, for other views.
        views = training_views(clip)
        middle = np.mean(avatar.splats(views[0][1]).means, axis=0)
        centers = {camera.id: camera.center for camera, _ in views}
        away = middle - np.stack([*centers.values()])
        away = away / np.linalg.norm(away, axis=1, keepdims=True)
        basis = sh_basis(torch.from_numpy(away), sh_degree(avatar.splat_tensors["sh_rest"])).numpy()
        metric = 0.2 * np.eye(basis.shape[1]) + 0.8 * 4 * np.pi * basis.T @ basis / len(basis)
        metrics[COLOURS] = np.kron(np.eye(3), metric)
    splats = {**avatar.splat_tensors, "binding": avatar.binding}
    splats["quats"] = normalize(splats["quats"], dim=1)
    source = _Splats(avatar, clip, _numpy(avatar.binding)).source(splats, {}, metrics)
    return Parts(bound, source, avatar.subject)


def _gbs(avatar: GBSAvatar, head: HeadAsset, clip: Clip | None) -> Parts:
    stored, coefficients = avatar.stored, np.ones(avatar.stored.expressions)
    if clip is not None:
        expressions = np.stack([pose.expression for pose in training_poses(clip)]).astype(np.float64)
        coefficients = np.sqrt((expressions**2).mean(0))[: stored.expressions]
    coefficients = np.maximum(coefficients, 1e-3 * max(float(np.max(coefficients, initial=0)), 1e-9))
    owners, moving = _numpy(stored.entries.owners), _numpy(stored.entries.expressions)
    moved_by = np.zeros((len(stored.points.triangles), stored.expressions), np.int64)
    moved_by[owners, moving] = 1
    order = _Splats(avatar, clip, stored.points.triangles)
    # Rows of the differences follow the order of the splats.
    rows = np.lexsort((moving, np.argsort(order.rows)[owners]))
    splats = {**stored.neutral, **point_tensors(stored.points), "moved_by": moved_by}
    others = {"differences": _numpy(stored.differences)[rows], "coefficients": coefficients}
    text = {EXPRESSIONS: str(stored.expressions)}
    return Parts(blended, order.source(splats, others, {}), avatar.subject, text)


def _gha(avatar: GHAAvatar, head: HeadAsset, clip: Clip | None) -> Parts:
    path = next(path for path in avatar.files() if path.name == AVATAR_FILE)
    others, metadata = read_safetensors(path)
    columns = others.pop(TABLE).numpy()
    splats = dict(zip((*POINTS, "features"), np.split(columns, np.cumsum([*POINTS.values()]), axis=1)))
    splats["opacities"] = splats["opacities"][:, 0]
    metrics = {"features": np.diag(np.maximum(splats["features"].std(0, np.float64), 1e-6) ** -2)}
    source = _Splats(avatar, clip, np.zeros(len(columns))).source(splats, others, metrics)
    return Parts(networks, source, avatar.subject, {CONFIG: metadata[CONFIG]})


def _insta(avatar: InstaAvatar, head: HeadAsset, clip: Clip | None) -> Parts:
    folder = avatar.files()[0].parent  # the files that the avatar was read from
    arrays, text = read_npz(folder / FIELD_FILE), {SETTINGS: json.dumps(read_json(folder / SETTINGS_FILE))}
    arrays["spread"] = np.maximum(arrays["table"].std(dtype=np.float64), 1e-9).reshape(1)
    return Parts(grid, CoderInput(arrays), read_subject(folder / SUBJECT_FILE, head), text)


def _rgbavatar(avatar: RGBAvatarAvatar, head: HeadAsset, clip: Clip | None) -> Parts:
    stored, metrics = avatar.stored, {}
    if clip is not None:  # the second moments of the blendshapes' weights in training
        inputs = tracked_inputs(avatar.mesh.arguments(training_poses(clip)), stored.settings.inputs)
        weights = blend_weights(stored.tensors, inputs).double().cpu().numpy()
        metrics["shapes"] = np.kron(weights.T @ weights / len(weights), np.eye(10))
    shapes = torch.cat([stored.tensors[name] for name in SHAPES.values()], dim=2)  # (K, N, 10)
    tensors = {name: value for name, value in stored.tensors.items() if name not in SHAPES.values()}
    return _surface(
        reduced, avatar, head, clip, tensors | {"shapes": shapes.transpose(0, 1).flatten(1)}, metrics
    )


def _flashavatar(avatar: FlashAvatarAvatar, head: HeadAsset, clip: Clip | None) -> Parts:
    tensors, metrics = avatar.stored.tensors, {}
    for name in filter(tensors.__contains__, gaussian_shapes(1)):
        metrics[name] = np.diag(np.abs(_numpy(tensors[name])).max(0, initial=1e-6) ** -2.0)
    return _surface(offsets, avatar, head, clip, tensors, metrics)


def _surface(
    layout: Layout,
    avatar: SurfaceAvatar[Any],
    head: HeadAsset,
    clip: Clip | None,
    tensors: Mapping[str, Tensor],
    metrics: Mapping[str, FloatArray],
) -> Parts:
    """Parts of splats on a surface; ``shapes`` has a row for each splat, too."""
    stored = avatar.stored
    rowwise = {"shapes", *(name for name, shape in stored.shapes(head).items() if shape[0] == "N")}
    splats = {name: value for name, value in tensors.items() if name in rowwise} | point_tensors(
        stored.points
    )
    others = {name: value for name, value in tensors.items() if name not in rowwise}
    source = _Splats(avatar, clip, stored.points.triangles).source(splats, others, metrics)
    return Parts(layout, source, avatar.subject, {stored.KEY: stored.text()})


ENCODERS: Mapping[type, Callable[[Any, HeadAsset, Clip | None], Parts]] = {
    OursAvatar: _ours,
    GAAvatar: _ga,
    GBSAvatar: _gbs,
    GHAAvatar: _gha,
    InstaAvatar: _insta,
    RGBAvatarAvatar: _rgbavatar,
    FlashAvatarAvatar: _flashavatar,
}
"""Arrays of the avatars of each method."""


Quality = dict[str, float | None]
"""PSNR (dB) and SSIM against the ground truth, means over frames, None without one; and ``psnr_exact``, dB against the renders
of the exact avatar, from the mean squared error over all frames, None if they are equal."""
WHOLE = "all"


@command("export compact", group="export", writes="out", kinds=("an avatar",))
def compact_avatar(settings: CompactSettings, progress: Progress = no_progress) -> CommandResult:
    """Store an avatar of a native method by the common codec, at a tenth of its size or less."""
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
            form = adapt(clip, needs, stored.heads, kept)
            comparison = Comparison(clip, form, exact, settings.frames, settings.scale)
        adapted = None if form is None else form.clip
        prepared = parts_of(exact, head, adapted)
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
        if adapted is not None:
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
