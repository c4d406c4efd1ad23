"""Codec for avatars of all native methods: stored tensors of each, and their visibility in training views.

All methods share the container, the entropy coder, the transform and the steps (`Precision`); they differ only in their
parts.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from ....bench.contracts import Avatar, Clip, FloatArray, HeadAsset, HeadPose, SplatAvatar
from ....bench.errors import InputError
from ....bench.io.arrays import Member, read_arrays
from ....bench.io.files import digest, read_bytes
from ...flashavatar.method import FlashAvatarAvatar
from ...ga.method import GAAvatar
from ...gbs.avatar import GBSAvatar
from ...gha.avatar import CONFIG, OF_CODE, TABLE, GHAAvatar
from ...insta.avatar import FIELD_FILE as INSTA_FILE
from ...insta.avatar import OCCUPIED, SETTINGS, SETTINGS_FILE, InstaAvatar, read_settings
from ...insta.avatar import TABLE as GRID
from ...insta.field import Architecture
from ...ours.avatar import OursAvatar
from ...rgbavatar.method import RGBAvatarAvatar
from ...rgbavatar.model import blend_weights
from ...shared.avatar_files import AVATAR_FILE, COMPACT_FILE, SUBJECT_FILE, read_subject, save_shared_head
from ...shared.capacity import training_poses
from ...shared.networks import tracked_inputs
from ...shared.tensor_files import read_safetensors
from ..views import importance, training_views
from .blended import encode_blended
from .bound import encode_bound
from .container import CODEC, Content, write_content
from .file import encode
from .networks import encode_networks
from .offsets import encode_offsets
from .precision import Precision
from .reduced import encode_reduced
from .simplify import simplify

CODEC_VERSION = 3
"""Codec version, increased when the same avatar and steps give different files."""
DRIVING_FILE = "driving.npz"
"""Driving signal beside the avatars of some methods, which is not part of their size."""


def encode_avatar(avatar: Avatar, head: HeadAsset, precision: Precision, clip: Clip | None = None) -> Content:
    """Content of the coded file of an avatar of any method of `ENCODERS`.

    With a clip, steps follow the visibility of each splat in its training views, and parts invisible in all training poses
    are left out.
    Raises `InputError` for an avatar of another method, and for one that was read from a coded file.
    """
    encoder = ENCODERS.get(type(avatar))
    if encoder is None:
        methods = "ours, ga, gbs, gha, insta, rgbavatar or flashavatar"
        raise InputError("avatar", "", f"one of {methods}", f"a {type(avatar).__name__}")
    if any(path.name == COMPACT_FILE for path in avatar.files()):
        raise InputError(avatar.files()[0], "", "the files of a training", "a coded avatar")
    content = encoder(avatar, head, precision, clip)
    return replace(content, text={**content.text, CODEC: codec_name(precision)})


def codec_name(precision: Precision) -> str:
    """Name of the codec with its steps: "2, steps x1", and a digest of the individual steps if they are not the defaults."""
    name = f"{CODEC_VERSION}, steps x{precision.step:g}"
    own = replace(precision, step=1.0)
    return name if own == Precision() else f"{name} ({digest(asdict(own))[:8]})"


def write_coded(
    avatar: Avatar, head: HeadAsset, out: Path, precision: Precision, clip: Clip | None, driving: Path | None
) -> Content:
    """Write the coded avatar, its head model and, if there is one, the file of its ``driving`` signal into a folder."""
    content = encode_avatar(avatar, head, precision, clip)
    save_shared_head(out, head)
    if driving is not None and driving.is_file():
        shutil.copyfile(driving, out / DRIVING_FILE)
    write_content(out / COMPACT_FILE, content)
    return content


def weights_of(avatar: SplatAvatar, clip: Clip | None) -> FloatArray | None:
    """(N,) importance of the splats in the training views of a clip, None without one."""
    return None if clip is None else importance(avatar, training_views(clip))


def _encode_ours(avatar: OursAvatar, head: HeadAsset, precision: Precision, clip: Clip | None) -> Content:
    poses: list[HeadPose] = [] if clip is None else training_poses(clip)
    field = simplify(avatar, poses, precision.scaled)
    simplified = OursAvatar([], avatar.mesh, avatar.subject, field, "cpu")
    return encode(field, avatar.subject, head, precision, weights_of(simplified, clip))


def _encode_ga(avatar: GAAvatar, head: HeadAsset, precision: Precision, clip: Clip | None) -> Content:
    directions = None
    if clip is not None:
        # The harmonics are in world space, where the cameras are static.
        views = training_views(clip)
        middle = np.mean(avatar.splats(views[0][1]).means, axis=0)
        places = {camera.id: camera.center for camera, _ in views}
        directions = np.stack([middle - place for place in places.values()])
        directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    splats = {name: value.cpu() for name, value in avatar.splat_tensors.items()}
    weights = weights_of(avatar, clip)
    return encode_bound(splats, avatar.binding.cpu(), avatar.subject, precision, weights, directions)


def _encode_gbs(avatar: GBSAvatar, head: HeadAsset, precision: Precision, clip: Clip | None) -> Content:
    coefficients = None
    if clip is not None:
        expressions = np.stack([pose.expression for pose in training_poses(clip)]).astype(np.float64)
        coefficients = np.sqrt((expressions**2).mean(0))
    weights = weights_of(avatar, clip)
    return encode_blended(avatar.stored, avatar.subject, head, precision, weights, coefficients)


def _encode_gha(avatar: GHAAvatar, head: HeadAsset, precision: Precision, clip: Clip | None) -> Content:
    path = _exact(avatar, AVATAR_FILE)
    tensors, metadata = read_safetensors(path)
    arrays = {name: value.numpy() for name, value in tensors.items()}
    exact = ("landmarks", "origin", "center", "background", *OF_CODE)
    options: dict[str, Any] = {"text": {CONFIG: metadata[CONFIG]}, "weights": weights_of(avatar, clip)}
    return encode_networks(arrays, avatar.subject, precision, splats=TABLE, exact=exact, **options)


def _encode_insta(avatar: InstaAvatar, head: HeadAsset, precision: Precision, clip: Clip | None) -> Content:
    path = _exact(avatar, INSTA_FILE)
    config = read_settings(path.parent / SETTINGS_FILE)
    shapes = Architecture.of(config, head.expression_basis.shape[2]).shapes()
    members = {name: Member("f", shape, dtype="f2") for name, shape in shapes.items()}
    arrays = read_arrays(path, {**members, OCCUPIED: Member("u", ("bytes",), dtype="u1")})
    subject = read_subject(path.parent / SUBJECT_FILE, head)
    text = {SETTINGS: read_bytes(path.parent / SETTINGS_FILE, "settings").decode()}
    return encode_networks(arrays, subject, precision, grid=GRID, text=text)


def _encode_rgbavatar(
    avatar: RGBAvatarAvatar, head: HeadAsset, precision: Precision, clip: Clip | None
) -> Content:
    moments = None
    if clip is not None:
        inputs = tracked_inputs(avatar.mesh.arguments(training_poses(clip)), avatar.stored.settings.inputs)
        found = blend_weights(avatar.stored.tensors, inputs).double().cpu().numpy()
        moments = found.T @ found / len(found)
    return encode_reduced(avatar.stored, avatar.subject, head, precision, weights_of(avatar, clip), moments)


def _encode_flashavatar(
    avatar: FlashAvatarAvatar, head: HeadAsset, precision: Precision, clip: Clip | None
) -> Content:
    return encode_offsets(avatar.stored, avatar.subject, precision, weights_of(avatar, clip))


def _exact(avatar: Avatar, name: str) -> Path:
    return next(path for path in avatar.files() if path.name == name)


Encoder = Callable[[Any, HeadAsset, Precision, Clip | None], Content]
ENCODERS: Mapping[type, Encoder] = {
    OursAvatar: _encode_ours,
    GAAvatar: _encode_ga,
    GBSAvatar: _encode_gbs,
    GHAAvatar: _encode_gha,
    InstaAvatar: _encode_insta,
    RGBAvatarAvatar: _encode_rgbavatar,
    FlashAvatarAvatar: _encode_flashavatar,
}
"""How the avatars of each method are encoded; each method reads its own coded file."""
