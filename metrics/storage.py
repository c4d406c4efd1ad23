"""Storage of an avatar on disk, and bitrate of its driving signal. SI units."""

from __future__ import annotations

import lzma
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..bench.contracts import Avatar, Camera, HeadPose, Measurement, SharingAvatar, SplatAvatar
from ..bench.errors import InputError
from ..bench.specs import MetricSpec

STORAGE = MetricSpec(
    name="storage",
    label="Storage",
    unit="MB",
    higher_is_better=False,
    digits=2,
    implementation="headbench.metrics.storage:storage",
    summary="Bytes of the files needed to render the avatar, SI megabytes.",
    kind="avatar",
    tables=("comparison", "cost"),
    default=True,
)


def _detail(name: str, detail: str, label: str, unit: str, digits: int, summary: str) -> MetricSpec:
    """Another value measured with `STORAGE`; lower is better."""
    own = {"detail": detail, "label": label, "unit": unit, "digits": digits, "summary": summary}
    return replace(STORAGE, name=name, tables=("cost",), **own)  # type: ignore[arg-type]


_SHARED = "Assets that all avatars of a method share, such as the head model."
_PACKED = "The avatar's files packed losslessly by xz."
_PER_PRIMITIVE = "Bytes of the avatar's files over its primitives."
_DRIVING = "Driving signal as float32, at 25 frames per second."
STORAGE_PACKED = _detail("storage_packed", "packed_mb", "Packed", "MB", 2, _PACKED)
STORAGE_SHARED = _detail("storage_shared", "shared_mb", "Shared", "MB", 2, _SHARED)
PRIMITIVES = _detail("primitives", "primitives", "Primitives", "", 0, "Number of splats.")
PRIMITIVE_BYTES = _detail("primitive_bytes", "primitive_bytes", "Per primitive", "B", 1, _PER_PRIMITIVE)
DRIVING_BITRATE = _detail("driving_bitrate", "driving_kb_s", "Driving", "kB/s", 2, _DRIVING)

MEGA, KILO = 1e6, 1e3
DRIVING_RATE = 25.0  # frames per second at which the driving signal's bitrate is given
PACKING = 6  # xz's default; higher levels take more memory than most avatars
CHUNK = 1 << 20


def storage(avatar: Avatar, workload: Sequence[tuple[Camera, HeadPose]] = ()) -> Measurement:
    """Size of all files needed to render ``avatar``, in megabytes (SI: 1 MB = 1 000 000 bytes).

    The avatar declares its files (`Avatar.files`: shared assets and the driving signal do not count); a file
    that is listed twice counts once.

    Details: ``bytes``; ``files``; ``packed_mb``, the files packed losslessly by xz one after the other;
    ``shared_mb``, if the avatar declares its shared assets; ``primitives`` and ``primitive_bytes`` (bytes of all
    files over primitives), if it has splats and ``workload`` a pose; ``driving_bytes`` of one pose as float32 and
    ``driving_kb_s``, kilobytes per second at 25 frames per second, if ``workload`` has a pose.
    """
    files = _checked(avatar.files())
    if not files:
        raise InputError("avatar", "files()", "at least one file", "none")
    size = sum(path.stat().st_size for path in files)
    details: dict[str, float] = {"bytes": size, "files": len(files), "packed_mb": packed_bytes(files) / MEGA}
    if isinstance(avatar, SharingAvatar):
        details["shared_mb"] = sum(path.stat().st_size for path in _checked(avatar.shared_files())) / MEGA
    for _, pose in workload[:1]:
        details["driving_bytes"] = driving_bytes(pose)
        details["driving_kb_s"] = driving_bytes(pose) * DRIVING_RATE / KILO
        if isinstance(avatar, SplatAvatar):
            count = len(avatar.splats(pose).means)
            details["primitives"] = count
            if count:
                details["primitive_bytes"] = size / count
    return Measurement(size / MEGA, details)


def packed_bytes(files: Iterable[Path]) -> int:
    """Size of the files' contents in one xz stream; memory use does not depend on file sizes."""
    packer = lzma.LZMACompressor(preset=PACKING)
    size = 0
    for path in files:
        with path.open("rb") as stream:
            while chunk := stream.read(CHUNK):
                size += len(packer.compress(chunk))
    return size + len(packer.flush())


def driving_bytes(pose: HeadPose) -> int:
    """Bytes of one timestep of a driving signal as float32: expression, rotations, translation, eyelids if any."""
    parts = (pose.expression, pose.rotation, pose.neck, pose.jaw, pose.eyes, pose.translation, pose.eyelids)
    return 4 * sum(np.asarray(part).size for part in parts if part is not None)


def _checked(paths: Iterable[Path]) -> list[Path]:
    """Distinct files, sorted."""
    files = sorted({path.resolve() for path in paths})
    for path in files:
        if not path.is_file():
            found = "a folder" if path.is_dir() else "nothing there"
            raise InputError(path, "", "a file of the avatar", found)
    return files
