"""Storage: what an avatar occupies on disk."""

from __future__ import annotations

from collections.abc import Sequence

from ..bench.contracts import Avatar, Camera, HeadPose, Measurement
from ..bench.errors import InputError


def storage(avatar: Avatar, workload: Sequence[tuple[Camera, HeadPose]] = ()) -> Measurement:
    """Size of all files needed to render ``avatar``, in megabytes (SI: 1 MB = 1 000 000 bytes).

    The avatar declares its files (`Avatar.files`: shared assets and the driving signal do not count); one that
    it names twice counts once. ``workload`` plays no part. Details: bytes, files.

    Raises `InputError` where the avatar names no file, or one that is not there.
    """
    files = sorted({path.resolve() for path in avatar.files()})
    if not files:
        raise InputError("avatar", "files()", "at least one file", "none")
    for path in files:
        if not path.is_file():
            raise InputError(
                path, "", "a file of the avatar", "a folder" if path.is_dir() else "nothing there"
            )
    size = sum(path.stat().st_size for path in files)
    return Measurement(size / 1e6, {"bytes": size, "files": len(files)})
