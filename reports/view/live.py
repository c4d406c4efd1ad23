"""Live signals for the viewer: lines of JSON from standard input or a local port, converted to poses."""

from __future__ import annotations

import logging
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import BinaryIO

from ...bench.contracts import HeadPose
from ...bench.errors import HeadbenchError, InputError, text_of
from ...bench.io.documents import parse_json
from ...bench.registry import resolve
from .scene import Scene
from .settings import STANDARD_INPUT, ViewSettings

log = logging.getLogger(__name__)

DRIVER = "headbench.datasets.drive.transfer:LiveDriver"
"""Converts lines to poses of a head model; referred to by name, since this package imports no reader."""
LOOPBACK = "127.0.0.1"
LONGEST_LINE = 2**20
SILENCE_S = 60.0
"""Seconds without a line after which a connection is closed."""
"""Bytes; a frame of blendshapes has 2,000."""


class LivePoses:
    """The pose of the latest line, for each head model. Of lines that arrive during a conversion, only the last is used.

    Parameters
    ----------
    drivers : Mapping[str, Callable[[str], HeadPose]]
        Convert a line, by the version of the head model.
    """

    def __init__(self, drivers: Mapping[str, Callable[[str], HeadPose]]):
        self._drivers = drivers
        self._poses: dict[str, HeadPose] = {}
        self._listeners: set[Callable[[], None]] = set()
        self._arrived = threading.Condition()
        self._line: str | None = None
        self._closed, self._said = False, ""
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def pose(self, version: str) -> HeadPose | None:
        """The latest pose of a head model, relative to that of the first line; None before a line has arrived."""
        return self._poses.get(version)

    def put(self, line: str) -> None:
        """Receive a line."""
        with self._arrived:
            self._line = line
            self._arrived.notify()

    def listen(self, listener: Callable[[], None]) -> None:
        """Call ``listener`` after each new pose."""
        self._listeners.add(listener)

    def forget(self, listener: Callable[[], None]) -> None:
        """Remove a listener."""
        self._listeners.discard(listener)

    def close(self) -> None:
        """Stop the thread."""
        with self._arrived:
            self._closed = True
            self._arrived.notify()
        self._thread.join(timeout=10.0)

    def _run(self) -> None:
        while True:
            with self._arrived:
                self._arrived.wait_for(lambda: self._closed or self._line is not None)
                line, self._line = self._line, None
            if self._closed or line is None:
                return
            try:
                self._poses = {version: driver(line) for version, driver in self._drivers.items()}
            except Exception as error:  # the next line may be a good one
                if text_of(error) != self._said:  # an invalid signal would repeat the message for each line
                    self._said = text_of(error)
                    known = isinstance(error, HeadbenchError)
                    log.warning("%s", error if known else f"live signal: {self._said}", exc_info=not known)
                continue
            for listener in tuple(self._listeners):
                listener()


@contextmanager
def with_live_signal(scene: Scene, settings: ViewSettings) -> Iterator[Scene]:
    """The scene with the live signal of the settings, if any; it ends with the block.

    Raises `InputError` for a port that is taken, and a head model file that cannot be read.
    """
    if not settings.live:
        yield scene
        return
    make = resolve(DRIVER)
    heads = {shown.version: shown.form.clip.head for shown in scene.shown}
    live = LivePoses({version: make(head, settings.signal_head) for version, head in heads.items()})
    try:
        with (
            standard_input(live) if settings.live == STANDARD_INPUT else local_port(live, int(settings.live))
        ):
            yield replace(scene, shown=[replace(shown, live=live) for shown in scene.shown])
    finally:
        live.close()


@contextmanager
def standard_input(live: LivePoses) -> Iterator[None]:
    """Read lines of standard input in a thread, which ends with the input or the process."""
    threading.Thread(target=_read, args=(sys.stdin.buffer, live), daemon=True).start()
    yield


@contextmanager
def local_port(live: LivePoses, port: int) -> Iterator[int]:
    """Listen at a local port for one local program at a time; yield the port (a free one for 0)."""
    try:
        server = socket.create_server((LOOPBACK, port), backlog=1)
    except OSError as error:
        expected = "a port of this machine that is free"
        raise InputError("command line", "--live", expected, f"{port}: {error}", "Choose another.") from None
    connected: list[socket.socket] = []
    thread = threading.Thread(target=_serve, args=(server, live, connected), daemon=True)
    thread.start()
    try:
        yield server.getsockname()[1]
    finally:
        for end in (server, *connected):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        server.close()
        thread.join(timeout=10.0)


def _serve(server: socket.socket, live: LivePoses, connected: list[socket.socket]) -> None:
    while True:
        try:
            connection, _ = server.accept()
        except OSError:  # closed
            return
        connection.settimeout(SILENCE_S)  # close idle connections, so that another program can connect
        connected[:] = [connection]
        with connection, connection.makefile("rb") as stream:
            _read(stream, live)
        connected.clear()


def _read(stream: BinaryIO, live: LivePoses) -> None:
    """Receive lines until the end or the first that is not a JSON object, such as a browser's request."""
    with suppress(OSError):
        while line := stream.readline(LONGEST_LINE):
            try:
                text = line.decode()
                if not text.strip():
                    continue
                parse_json(text, "live signal", "line")
            except (HeadbenchError, UnicodeDecodeError) as error:
                log.warning("the live signal has ended: %s", error)
                return
            live.put(text)
