"""Encoding of avatars of all native methods: the tensors of each, and their visibility in training views.

All methods share the file, the coder and the steps (`Precision`); they differ only in their layouts.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from ....bench.contracts import Avatar, Clip, FloatArray, HeadAsset, IntArray, SplatAvatar
from ....bench.errors import InputError
from ....bench.io.arrays import Member, read_arrays
from ....bench.io.files import digest, read_bytes
from ...flashavatar.method import FlashAvatarAvatar
from ...ga.method import GAAvatar
from ...gbs.avatar import GBSAvatar
from ...gbs.storage import EXPRESSIONS
from ...gha.avatar import CONFIG, TABLE, GHAAvatar
from ...gha.gaussian_head import POINTS
from ...insta.avatar import FIELD_FILE, OCCUPIED, SETTINGS, SETTINGS_FILE, InstaAvatar, read_settings
from ...insta.field import Architecture
from ...ours.avatar import OursAvatar
from ...ours.storage import DYNAMIC, PER_SPLAT, splat_columns
from ...rgbavatar.method import RGBAvatarAvatar
from ...rgbavatar.model import SHAPES, blend_weights
from ...shared.avatar_files import (
    AVATAR_FILE,
    COMPACT_FILE,
    SUBJECT_FILE,
    Subject,
    read_subject,
    save_shared_head,
)
from ...shared.capacity import training_poses
from ...shared.networks import tracked_inputs
from ...shared.surface_points import point_tensors
from ...shared.surface_splats import SurfaceAvatar
from ...shared.tensor_files import read_safetensors
from ..views import importance, training_views
from .coder import Coder, Source, visibility_classes
from .container import CODEC, Content, write_content
from .field import field
from .layouts import Layout, blended, bound, code_subject, grid, networks, offsets, reduced
from .precision import Precision

CODEC_VERSION = 4
"""Codec version, increased when the same avatar and steps give different files."""
DRIVING_FILE = "driving.npz"
"""Driving signal beside the avatars of some methods, which is not part of their size."""
MAX_SETTINGS = 2**20


class Parts(NamedTuple):
    """An avatar to encode: layout, source, subject and texts; splats in any order."""

    layout: Layout
    source: Source
    subject: Subject
    text: Mapping[str, str] = {}


def write_coded(
    avatar: Avatar, head: HeadAsset, out: Path, precision: Precision, clip: Clip | None, driving: Path | None
) -> dict[str, int]:
    """Write the coded avatar, its head model and, if there is one, the file of its ``driving`` signal into a folder.

    With a clip, steps follow the visibility of each splat in its training views. Returns the bytes of each part. Raises
    `InputError` for an avatar of a method that has no codec, and for one that was read from a coded file.
    """
    content, parts = encode_avatar(avatar, head, precision, clip)
    save_shared_head(out, head)
    if driving is not None and driving.is_file():
        shutil.copyfile(driving, out / DRIVING_FILE)
    sizes: dict[str, int] = {}
    for name, size in write_content(out / COMPACT_FILE, content).items():
        sizes[parts[name]] = sizes.get(parts[name], 0) + size
    return sizes


def encode_avatar(
    avatar: Avatar, head: HeadAsset, precision: Precision, clip: Clip | None = None
) -> tuple[Content, dict[str, str]]:
    """Content of the coded file of an avatar, and the part of each array; see `write_coded`."""
    parts_of = ENCODERS.get(type(avatar))
    if parts_of is None:
        methods = "ours, ga, gbs, gha, insta, rgbavatar or flashavatar"
        raise InputError("avatar", "", f"one of {methods}", f"a {type(avatar).__name__}")
    if any(path.name == COMPACT_FILE for path in avatar.files()):
        raise InputError(avatar.files()[0], "", "the files of a training", "a coded avatar")
    found, scaled = parts_of(avatar, head, clip), precision.scaled
    text = {"name": found.subject.name, "head_model": found.subject.head_model, **found.text}
    coder = Coder(scaled, text, found.source)
    found.layout(coder, head, code_subject(coder, head, found.subject))
    assert not coder.left
    text[CODEC] = codec_name(precision)
    return Content(coder.arrays, text, scaled.parts), coder.parts


def codec_name(precision: Precision) -> str:
    """Name of the codec with its steps: "2, steps x1", and a digest of the individual steps if they are not the defaults."""
    name = f"{CODEC_VERSION}, steps x{precision.step:g}"
    own = replace(precision, step=1.0)
    return name if own == Precision() else f"{name} ({digest(asdict(own))[:8]})"


class _Order:
    """Order of splats in the file: by visibility, whose classes have values of similar range, then by place.

    Parameters
    ----------
    places : Tensor | np.ndarray
        (N,) triangles of the splats, or numbers along a curve through space.
    """

    def __init__(self, avatar: SplatAvatar, clip: Clip | None, places: Tensor | np.ndarray):
        weights = None if clip is None else importance(avatar, training_views(clip))
        self.rows = np.lexsort((_numpy(places), visibility_classes(weights, len(places))))
        self._weights = None if weights is None else weights[self.rows]

    def source(
        self,
        splats: Mapping[str, Tensor | np.ndarray],
        others: Mapping[str, Tensor | np.ndarray],
        metrics: Mapping[str, FloatArray] | None = None,
    ) -> Source:
        """Source of arrays with a row for each splat, and of others."""
        arrays = {name: _numpy(value)[self.rows] for name, value in splats.items()}
        return Source(
            arrays | {n: _numpy(value) for n, value in others.items()}, self._weights, metrics or {}
        )


def _numpy(values: Tensor | np.ndarray) -> np.ndarray:
    return values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)


def _morton(points: FloatArray, bits: int = 10) -> IntArray:
    """Numbers of (N, 3) points along a Morton curve."""
    low, high = points.min(0, initial=np.inf), points.max(0, initial=-np.inf)
    cells = ((points - low) / np.maximum(high - low, 1e-12) * (2**bits - 1)).astype(np.int64)
    return np.asarray(sum(((cells >> bit & 1) << np.arange(3)).sum(1) << 3 * bit for bit in range(bits)))


def _ours(avatar: OursAvatar, head: HeadAsset, clip: Clip | None) -> Parts:
    others = dict(avatar.field.tensors)
    rows = splat_columns(others.pop("splats"))
    rows |= {name: rows[name][:, 0] for name in ("opacities", "binding")}
    rows |= {name: others.pop(name) for name in PER_SPLAT if name in others}
    source = _Order(avatar, clip, rows["binding"]).source(rows, others)
    return Parts(field, source, avatar.subject, {DYNAMIC: ",".join(avatar.field.dynamic)})


def _ga(avatar: GAAvatar, head: HeadAsset, clip: Clip | None) -> Parts:
    metrics = {}
    if clip is not None:
        # The harmonics are in world space, where the cameras are static.
        views = training_views(clip)
        middle = np.mean(avatar.splats(views[0][1]).means, axis=0)
        places = {camera.id: camera.center for camera, _ in views}
        directions = np.stack([middle - place for place in places.values()])
        metrics["directions"] = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    rows = {**avatar.splat_tensors, "binding": avatar.binding}
    source = _Order(avatar, clip, avatar.binding).source(rows, {}, metrics)
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
    order = _Order(avatar, clip, stored.points.triangles)
    # Rows of the differences follow the order of the splats.
    place = np.argsort(order.rows)
    differences = _numpy(stored.differences)[np.lexsort((moving, place[owners]))]
    rows = {**stored.neutral, **point_tensors(stored.points), "moved_by": moved_by}
    others = {"differences": differences, "coefficients": coefficients}
    text = {EXPRESSIONS: str(stored.expressions)}
    return Parts(blended, order.source(rows, others), avatar.subject, text)


def _gha(avatar: GHAAvatar, head: HeadAsset, clip: Clip | None) -> Parts:
    path = next(path for path in avatar.files() if path.name == AVATAR_FILE)
    others, metadata = read_safetensors(path)
    table = others.pop(TABLE).numpy()
    columns = np.split(table, np.cumsum([*POINTS.values()]), axis=1)
    rows = dict(zip((*POINTS, "features"), columns))
    rows["opacities"] = rows["opacities"][:, 0]
    source = _Order(avatar, clip, _morton(rows["points"])).source(rows, others)
    return Parts(networks, source, avatar.subject, {CONFIG: metadata[CONFIG]})


def _insta(avatar: InstaAvatar, head: HeadAsset, clip: Clip | None) -> Parts:
    folder = next(path for path in avatar.files() if path.name == FIELD_FILE).parent
    shapes = Architecture.of(read_settings(folder / SETTINGS_FILE), head.expression_basis.shape[2]).shapes()
    members = {name: Member("f", shape, dtype="f2") for name, shape in shapes.items()}
    arrays = read_arrays(folder / FIELD_FILE, {**members, OCCUPIED: Member("u", ("bytes",), dtype="u1")})
    text = {SETTINGS: read_bytes(folder / SETTINGS_FILE, "settings", MAX_SETTINGS).decode()}
    return Parts(grid, Source(arrays), read_subject(folder / SUBJECT_FILE, head), text)


def _rgbavatar(avatar: RGBAvatarAvatar, head: HeadAsset, clip: Clip | None) -> Parts:
    metrics = {}
    if clip is not None:
        inputs = tracked_inputs(avatar.mesh.arguments(training_poses(clip)), avatar.stored.settings.inputs)
        found = blend_weights(avatar.stored.tensors, inputs).double().cpu().numpy()
        metrics["shapes"] = np.kron(found.T @ found / len(found), np.eye(10))
    shapes = {name: avatar.stored.tensors[name].swapaxes(0, 1) for name in SHAPES.values()}
    return _surface(reduced, avatar, head, clip, shapes, metrics)


def _flashavatar(avatar: FlashAvatarAvatar, head: HeadAsset, clip: Clip | None) -> Parts:
    return _surface(offsets, avatar, head, clip)


def _surface(
    layout: Layout,
    avatar: SurfaceAvatar[Any],
    head: HeadAsset,
    clip: Clip | None,
    shapes: Mapping[str, Tensor] = {},
    metrics: Mapping[str, FloatArray] = {},
) -> Parts:
    """Parts of splats on a surface; ``shapes`` are those of its tensors that have splats on the second axis, swapped."""
    stored = avatar.stored
    widths = stored.shapes(head)
    rows = {name: value for name, value in stored.tensors.items() if widths[name][0] == "N"}
    others = {name: value for name, value in stored.tensors.items() if name not in {*rows, *shapes}}
    rows |= {**shapes, **point_tensors(stored.points)}
    source = _Order(avatar, clip, stored.points.triangles).source(rows, others, metrics)
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
