"""The process of an isolated method: it trains from a clip without test images, or renders a stored avatar."""

from __future__ import annotations

import ctypes
import logging
import signal
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from ..contracts import (
    Avatar,
    ByteArray,
    CheckedMethod,
    CodedAvatar,
    FloatArray,
    FrameKey,
    IntArray,
    PreparedMethod,
    SharingAvatar,
    SplatAvatar,
)
from ..errors import HeadbenchError, InputError, UnavailableError, text_of
from .landlock import restrict
from .messages import receive, send

PROGRESS_EVERY_S = 0.1
_PARENT_DEATH_SIGNAL = 1


@dataclass(frozen=True)
class StoredHead:
    """The arrays of a head model, see `HeadAsset`."""

    version: str
    template: FloatArray
    faces: IntArray
    shape_basis: FloatArray
    expression_basis: FloatArray
    pose_basis: FloatArray
    joint_regressor: FloatArray
    skinning_weights: FloatArray
    parents: IntArray
    eyelid_basis: FloatArray | None
    regions: Mapping[str, IntArray]
    uv: FloatArray | None


class RemoteClip:
    """A `Clip` that requests training images from the run; it has no other images."""

    def __init__(self, fields: Mapping[str, Any], connection: Connection):
        self.__dict__.update(fields)
        self._connection = connection

    def image(self, key: FrameKey) -> ByteArray:
        """(H, W, 3) 8-bit sRGB of a training frame. Raises `HeadbenchError` for any other."""
        image = self._asked("image", key)
        assert image is not None
        return image

    def mask(self, key: FrameKey) -> ByteArray | None:
        """(H, W) 8-bit coverage of a training frame, None if the capture has none."""
        return self._asked("mask", key)

    def _asked(self, what: str, key: FrameKey) -> ByteArray | None:
        send(self._connection, {"ask": what, "key": list(key)})
        answer, arrays = receive(self._connection)
        if "error" in answer:
            raise HeadbenchError(answer["error"])
        return arrays.get("pixels")


def main(descriptor: int) -> None:
    """Serve one run over a connected socket until it closes."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PARENT_DEATH_SIGNAL, signal.SIGKILL)
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the run ends this process
    connection = Connection(descriptor)
    limits, _ = receive(connection)
    sys.path[:] = limits["path"]
    send(connection, {"landlock": restrict(limits["read"], limits["write"])})
    logging.basicConfig(level=logging.INFO, handlers=[_Forwarded(connection)], force=True)
    served: Any = None
    while True:
        try:
            arguments = connection.recv()  # from the run, which started this process
        except EOFError:
            return
        try:
            if served is None:
                served = _Method(connection, arguments.pop("method"))
            values, arrays = getattr(served, arguments.pop("call"))(**arguments)
        except Exception as error:  # noqa: BLE001  # any error of a method is reported to the run
            send(connection, _described(error))
        else:
            send(connection, {"done": values}, arrays)


class _Method:
    """Functions that the run can call, by name."""

    def __init__(self, connection: Connection, resolved: Any):
        self._connection, self._method = connection, resolved.create()
        self._avatar: Avatar | None = None

    def check(self, clip: Any, budget: Any) -> Any:
        if isinstance(self._method, CheckedMethod):
            view: Any = None if clip is None else RemoteClip(clip, self._connection)
            self._method.check(view, budget)
        return None, {}

    def prepare(self, device: str) -> Any:
        if isinstance(self._method, PreparedMethod):
            self._method.prepare(device)
        return None, {}

    def fit(self, clip: Any, out: str, budget: Any, device: str, seed: int) -> Any:
        report = _Progress(self._connection)
        view = RemoteClip(clip, self._connection)
        self._method.fit(view, Path(out), budget, device=device, seed=seed, progress=report)
        return None, {}

    def load(self, path: str, device: str) -> Any:
        self._avatar = avatar = self._method.load(Path(path), device=device)
        shared = [str(file) for file in avatar.shared_files()] if isinstance(avatar, SharingAvatar) else None
        files = [str(file) for file in avatar.files()]
        codec = avatar.codec if isinstance(avatar, CodedAvatar) else ""
        found = {"splats": isinstance(avatar, SplatAvatar), "files": files, "shared": shared, "codec": codec}
        return found, {}

    def render(self, camera: Any, pose: Any, background: Any) -> Any:
        assert self._avatar is not None
        return None, self._avatar.render(camera, pose, background)._asdict()

    def splats(self, pose: Any, camera: Any) -> Any:
        assert isinstance(self._avatar, SplatAvatar)
        splats = self._avatar.splats(pose, camera)
        names = ("means", "quats", "scales", "opacities", "colors")
        found = {name: getattr(splats, name) for name in names}
        return None, {name: np.asarray(values) for name, values in found.items() if values is not None}

    def measure(self, metric: Any, workload: Any) -> Any:
        value, details = metric(self._avatar, workload)
        return [float(value), {str(name): float(each) for name, each in details.items()}], {}


class _Progress:
    def __init__(self, connection: Connection):
        self._connection, self._last = connection, 0.0

    def __call__(self, done: int, total: int, note: str = "") -> None:
        now = time.monotonic()
        if now - self._last > PROGRESS_EVERY_S or done == total:
            self._last = now
            send(self._connection, {"progress": [int(done), int(total), str(note)]})


class _Forwarded(logging.Handler):
    """Sends log messages to the run."""

    def __init__(self, connection: Connection):
        super().__init__()
        self._connection = connection

    def emit(self, record: logging.LogRecord) -> None:
        send(self._connection, {"log": [record.levelno, record.name, record.getMessage()[:4000]]})


def _described(error: Exception) -> dict[str, Any]:
    """An error as a message, with the parts of error types that the run distinguishes."""
    if isinstance(error, InputError):
        parts = [error.file, error.key, error.expected, error.found, error.remedy]
    elif isinstance(error, UnavailableError):
        parts = [error.what, error.remedy, error.note]
    else:
        parts = [text_of(error)]
    kinds = {
        InputError: "input",
        UnavailableError: "unavailable",
        MemoryError: "memory",
        HeadbenchError: "headbench",
    }
    kind = next((name for type_, name in kinds.items() if isinstance(error, type_)), type(error).__name__)
    return {"failed": kind, "parts": parts}
