"""Runs a method in separate processes without access to test images.

``fit`` runs in a process that receives the clip without images and requests those of training frames one by one; ``render``
runs in another one, which receives cameras, poses and the folder of the avatar. If the kernel has Landlock, neither can
read the capture, the rest of the run or the memory of other processes, change files outside its folder, or open TCP
connections. The page SECURITY.md states what this does not prevent.
"""

from __future__ import annotations

import logging
import os
import resource
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from pickle import PicklingError
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, ClassVar, Self

from ..contracts import (
    Budget,
    Camera,
    Clip,
    Frame,
    FrameKey,
    HeadPose,
    Measurement,
    Progress,
    no_progress,
)
from ..errors import ChangedInputError, HeadbenchError, InputError, UnavailableError, shortened
from ..orphans import end_orphans, set_subreaper
from ..start import starting_workers
from .child import StoredHead
from .landlock import SYSTEM, devices, without
from .messages import Arrays, receive, send

GRACE_S = 10.0
"""Seconds for a process to end after its connection is closed."""


class IsolatedMethod:
    """A `Method` whose code runs in separate processes.

    Parameters
    ----------
    resolved : ResolvedMethod
        The method with its settings.
    out : Path
        Folder of its avatar, the only one that the method can write to.
    hidden : Sequence[Path]
        Files and folders that its processes must not read: the captures and the run.
    """

    def __init__(self, resolved: Any, out: Path, hidden: Sequence[Path] = ()):
        self._resolved, self._out, self._hidden = resolved, out, hidden
        self._prepared: _Process | None = None
        self.landlock = 0
        """Version of Landlock that restricted the process of the last training."""

    def check(self, clip: Clip | None, budget: Budget) -> None:
        """Let the method check its settings and the clip, if it can."""
        with self._process() as process:
            process.call("check", clip, clip=None if clip is None else described(clip), budget=budget)

    def prepare(self, device: str) -> None:
        """Start the training process, which imports and compiles what it needs."""
        self._out.mkdir(parents=True, exist_ok=True)
        self._prepared = self._process(write=(self._out,)).__enter__()
        self._prepared.call("prepare", device=device)

    def fit(
        self,
        clip: Clip,
        out: Path,
        budget: Budget,
        *,
        device: str,
        seed: int,
        progress: Progress = no_progress,
    ) -> None:
        """Train as `Method.fit` does; the avatar is read by `load`."""
        if self._prepared is None:
            self.prepare(device)
        assert self._prepared is not None
        process, self._prepared = self._prepared, None
        self.landlock = process.landlock
        with process:
            values: dict[str, Any] = {
                "clip": described(clip),
                "out": str(out),
                "budget": budget,
                "device": device,
                "seed": seed,
            }
            process.call("fit", clip, progress, **values)

    def load(self, path: Path, *, device: str) -> IsolatedAvatar:
        """Start a process that loads the avatar and renders it."""
        process = self._process(read=(path,)).__enter__()
        try:
            found, _ = process.call("load", path=str(path), device=device)
            kind = IsolatedSplats if found["splats"] else IsolatedAvatar
            return kind(process, path, found["files"], found["shared"], str(found["codec"]))
        except BaseException:
            process.__exit__()
            raise

    def _process(self, read: Sequence[Path] = (), write: Sequence[Path] = ()) -> _Process:
        return _Process(self._resolved, read, write, self._hidden)


class IsolatedAvatar:
    """An `Avatar` in a separate process, which ends with it."""

    def __init__(
        self, process: _Process, folder: Path, files: Sequence[str], shared: Sequence[str] | None, codec: str
    ):
        self.process, self._files, self.codec = process, tuple(map(Path, files)), codec
        if shared is not None:  # makes this a `SharingAvatar`
            self.shared_files = lambda: tuple(map(Path, shared))
        for path in self._files:
            if not path.resolve().is_relative_to(folder.resolve()):
                raise InputError(folder, "files()", "files in the folder of the avatar", str(path))

    def render(self, camera: Camera, pose: HeadPose, background: Sequence[float] = (1.0, 1.0, 1.0)) -> Frame:
        """Render one frame; the values are returned as the process sent them."""
        asked: dict[str, Any] = {
            "camera": camera,
            "pose": pose,
            "background": tuple(float(value) for value in background),
        }
        _, arrays = self.process.call("render", **asked)
        try:
            return Frame(arrays["rgb"], arrays["alpha"])
        except KeyError as error:
            raise HeadbenchError(f"the avatar's frame has no {error}") from error

    def files(self) -> Sequence[Path]:
        """Files in the avatar's folder that it declares as needed."""
        return self._files

    def measured(
        self, metric: Callable[..., Any], workload: Sequence[tuple[Camera, HeadPose]]
    ) -> Measurement:
        """Measure the avatar in its process, so that times exclude the transfer of frames."""
        found, _ = self.process.call("measure", metric=metric, workload=list(workload))
        value, details = found
        return Measurement(float(value), {str(name): float(each) for name, each in details.items()})

    def close(self) -> None:
        """End the process."""
        self.process.__exit__()

    def __del__(self) -> None:
        self.close()


class IsolatedSplats(IsolatedAvatar):
    """A `SplatAvatar` in a separate process."""

    def splats(self, pose: HeadPose, camera: Camera | None = None) -> Any:
        """Splats of a pose."""
        _, arrays = self.process.call("splats", pose=pose, camera=camera)
        return SimpleNamespace(**{"colors": None, **arrays})


class _Process:
    """A process of a method, started by `__enter__`. ``hidden`` paths are inaccessible, except for ``read`` and ``write``."""

    running: ClassVar[set[int]] = set()
    """Ids of all such processes."""
    earlier: ClassVar[bool | None] = None
    """Whether this process was a subreaper before the first of them started."""

    def __init__(self, resolved: Any, read: Sequence[Path], write: Sequence[Path], hidden: Sequence[Path]):
        self._resolved, self._read, self._write, self._hidden = resolved, read, write, hidden
        self._started: subprocess.Popen[bytes] | None = None
        self._sent_method = False
        self.landlock = 0
        self._before = _priorities()

    def __enter__(self) -> Self:
        if self._started is not None:
            return self
        earlier = set_subreaper(True)
        if not self.running:
            type(self).earlier = earlier
        own, other = socket.socketpair()
        self._scratch = TemporaryDirectory(ignore_cleanup_errors=True)
        code = f"from {__package__}.child import main; main({other.fileno()})"
        environment = {
            **os.environ,
            "TMPDIR": self._scratch.name,
            "PYTHONPATH": os.pathsep.join(_search_path()),
        }
        with starting_workers():
            self._started = subprocess.Popen(
                [sys.executable, "-c", code],
                pass_fds=[other.fileno()],
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=2,  # output of a plug-in is not part of the command's output
                start_new_session=True,
            )
        other.close()
        self.running.add(self._started.pid)
        self._connection = Connection(own.detach())
        # Settings have defaults, so these paths may come from the plug-in itself.
        named = [
            *_texts(self._resolved.config),
            *(os.environ[n] for n in os.environ if n.startswith("HEADBENCH_")),
        ]
        known = [*SYSTEM, sys.prefix, sys.base_prefix, *_search_path(), *filter(os.path.isabs, named)]
        read = [*without(map(Path, known), self._hidden), *self._read]
        write = [*devices(), Path(self._scratch.name), *self._write]
        limits = {"path": _search_path(), "read": list(map(str, read)), "write": list(map(str, write))}
        try:
            send(self._connection, limits)
            self.landlock = int(self._next()[0]["landlock"])
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        started, self._started = self._started, None
        if started is None:
            return
        self._connection.close()
        try:
            with suppress(subprocess.TimeoutExpired):
                started.wait(GRACE_S if not error or error[0] is None else 0.1)
        finally:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(started.pid, signal.SIGKILL)  # with all processes in its session
            started.wait()
            end_orphans(self.running)
            self.running.discard(started.pid)
            if not self.running and self.earlier is not None:
                set_subreaper(self.earlier)
            self._scratch.cleanup()

    def call(
        self, name: str, source: Clip | None = None, progress: Progress = no_progress, /, **arguments: Any
    ) -> tuple[Any, Arrays]:
        """Call a function of the process, answering its requests for training images of ``source`` meanwhile.

        Raises
        ------
        ChangedInputError
            The method changed limits, priority or processors of this process.
        HeadbenchError
            The method raised an error or sent an invalid message, or its process ended.
        """
        if self._started is None:
            raise HeadbenchError("the process of the method has ended")
        if not self._sent_method:
            arguments["method"], self._sent_method = self._resolved, True
        try:
            self._connection.send({"call": name, **arguments})
        except (OSError, PicklingError, AttributeError, TypeError) as error:
            raise HeadbenchError(f"{name} cannot be called in a process of its own: {error}") from error
        while True:
            message, arrays = self._next()
            if "done" in message:
                if _priorities() != self._before:
                    raise ChangedInputError(
                        f"{self._resolved.spec.name} changed limits, priority or processors of the process of the run, which "
                        "later methods inherit. Its results are not recorded. Leave the method out."
                    )
                return message["done"], arrays
            if "failed" in message:
                raise _raised(message["failed"], message["parts"])
            if "ask" in message and source is not None:
                self._answer(message, source)
            elif "progress" in message:
                done, total, note = message["progress"]
                progress(int(done), int(total), shortened(str(note), 200))
            elif "log" in message:
                level, logger, text = message["log"]
                logging.getLogger(shortened(str(logger), 200)).log(
                    int(level), "%s", shortened(str(text), 4000)
                )
            else:
                raise HeadbenchError(
                    f"the process of the method sent an unexpected message: {sorted(message)[:5]}"
                )

    def _answer(self, message: Mapping[str, Any], clip: Clip) -> None:
        try:
            subject, sequence, timestep, camera = message["key"]
            key = FrameKey(str(subject), str(sequence), int(timestep), str(camera))
            pixels = clip.mask(key) if message["ask"] == "mask" else clip.image(key)
        except (HeadbenchError, KeyError, ValueError, TypeError) as error:
            send(self._connection, {"error": str(error)})
        else:
            send(self._connection, {}, {} if pixels is None else {"pixels": pixels})

    def _next(self) -> tuple[dict[str, Any], Arrays]:
        try:
            return receive(self._connection)
        except (EOFError, ConnectionError) as error:
            assert self._started is not None
            code = self._started.wait()
            if code == -signal.SIGKILL:
                raise HeadbenchError(
                    "the process of the method was killed, probably out of memory"
                ) from error
            raise HeadbenchError(f"the process of the method ended with exit code {code}") from error


def described(clip: Clip) -> dict[str, Any]:
    """Everything of a clip except its images, as plain values."""
    head = StoredHead(
        **{each.name: _plain(getattr(clip.head, each.name, None)) for each in fields(StoredHead)}
    )
    names = (
        "subject",
        "shape",
        "static_offset",
        "cameras",
        "poses",
        "splits",
        "excluded",
        "background",
        "fingerprint",
    )
    values = {name: _plain(getattr(clip, name)) for name in names}
    return {**values, "head": head, "steps": [_plain(step) for step in clip.steps]}


def _plain(value: Any) -> Any:
    """Convert mappings to dictionaries, since other mappings cannot be pickled."""
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        return type(value)(**{field.name: _plain(getattr(value, field.name)) for field in fields(value)})
    return value


def _raised(kind: str, parts: Sequence[Any]) -> Exception:
    texts = [shortened(str(part), 2000) for part in parts]
    if kind == "input" and len(texts) == 5:
        return InputError(*texts)
    if kind == "unavailable" and len(texts) == 3:
        return UnavailableError(*texts)
    if kind == "memory":
        return MemoryError(*texts)
    return HeadbenchError(texts[0] if kind == "headbench" else f"{kind}: {texts[0] if texts else ''}")


def _priorities() -> tuple[Any, ...]:
    """Properties of this process that any process of the same user can change, and that child processes inherit."""
    limits = [
        resource.getrlimit(getattr(resource, name)) for name in dir(resource) if name.startswith("RLIMIT_")
    ]
    processors = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else ()
    return limits, processors, os.getpriority(os.PRIO_PROCESS, 0)


def _search_path() -> list[str]:
    return list(dict.fromkeys(os.path.abspath(entry) for entry in sys.path))


def _texts(value: Any) -> list[str]:
    """All strings in settings, which may name files that the method reads."""
    if isinstance(value, (str, Path)):
        return [str(value)]
    if is_dataclass(value) and not isinstance(value, type):
        return [text for field in fields(value) for text in _texts(getattr(value, field.name))]
    if isinstance(value, Mapping):
        return [text for each in value.values() for text in _texts(each)]
    if isinstance(value, (list, tuple)):
        return [text for each in value for text in _texts(each)]
    return []
