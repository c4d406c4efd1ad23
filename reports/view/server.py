"""The viewer's server: a session for each browser, on viser."""

from __future__ import annotations

import hmac
import http
import importlib
import io
import logging
import secrets
import socket
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO
from unittest import mock

from ...bench.contracts import HeadPose, Progress, no_progress
from ...bench.errors import HeadbenchError, InputError, UnavailableError, install_extra, text_of
from ...bench.io.documents import parse_json
from ...bench.registry import resolve
from ...bench.specs import CommandResult, command
from .scene import STANDARD_INPUT, Scene, ViewSettings, open_scene
from .session import Session

log = logging.getLogger(__name__)


@contextmanager
def token_required() -> Iterator[str]:
    """Servers of websockets that start in this context refuse requests without the returned token; viser has no setting for it.

    Pages of other sites can send requests to this machine from its browsers, and other users of it too; neither know the token.
    Raises `RuntimeError` if no server starts.
    """
    import websockets.asyncio.server  # comes with viser

    token, started = secrets.token_urlsafe(24), []
    serve = websockets.asyncio.server.serve

    def guarded(*args: Any, process_request: Any, **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            first, _, rest = request.path.removeprefix("/").partition("/")
            if not hmac.compare_digest(first.encode(), token.encode()):
                text = "The address lacks the token. Open the address that was printed.\n"
                return connection.respond(http.HTTPStatus.FORBIDDEN, text)
            request.path = f"/{rest}"
            return process_request(connection, request)

        started.append(True)
        return serve(*args, process_request=process, **options)

    with mock.patch.object(websockets.asyncio.server, "serve", guarded):
        yield token
    if not started:
        raise RuntimeError("viser started its server in a way that is not known here, without the token")


DRIVER = "headbench.datasets.drive.transfer:LiveDriver"
"""Converts lines to poses of a head model; referred to by name, since this package imports no reader."""
LOOPBACK = "127.0.0.1"
LONGEST_LINE = 2**20
"""Bytes; a frame of blendshapes has 2,000."""
SILENCE_S = 60.0
"""Seconds without a line after which a connection is closed."""


class LivePoses:
    """The pose of the latest line, for each head model. Of lines that arrive during a conversion, only the last is used.

    ``drivers`` convert a line, by the version of the head model.
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
                    named = isinstance(error, HeadbenchError)
                    log.warning("%s", error if named else f"live signal: {self._said}", exc_info=not named)
                continue
            for listener in tuple(self._listeners):
                listener()


@contextmanager
def with_live_signal(scene: Scene, settings: ViewSettings) -> Iterator[Scene]:
    """The scene with the live signal of the settings, if any; it ends with the block."""
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


@command("view", group="inspect")
def view_avatars(settings: ViewSettings, progress: Progress = no_progress) -> CommandResult:
    """View avatars in a browser, side by side, with sliders and recorded sequences."""
    viser()
    check_port(settings.port)
    with tempfile.TemporaryDirectory(prefix="headbench-view-") as kept:
        opened = open_scene(settings, Path(kept))
        with with_live_signal(opened, settings) as scene, serving(scene, settings) as server:
            address = server.address
            names = ", ".join(shown.label for shown in scene.shown)
            log.warning("%s: %s (Ctrl-C ends it)", address, names)
            ends = None if settings.seconds is None else time.monotonic() + settings.seconds
            try:
                while ends is None or time.monotonic() < ends:
                    time.sleep(0.2)
            except KeyboardInterrupt:
                pass
    return CommandResult(f"the viewer of {names} has ended", {"address": address})


@contextmanager
def serving(scene: Scene, settings: ViewSettings) -> Iterator[Any]:
    """A running server, stopped at the end of the block: its ``address`` for browsers, and its ``sessions`` by client."""
    library = viser()
    with redirect_stdout(io.StringIO()), token_required() as token:  # viser prints a banner
        server = library.ViserServer(host=LOOPBACK, port=settings.port, label="headbench", verbose=False)
    server.address = f"http://{LOOPBACK}:{server.get_port()}/{token}/"
    # Disabled: any browser could request a tunnel to a public address, which would expose images of people.
    server.request_share_url = lambda verbose=True: None
    server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    # Drawing for a browser that disconnects is discarded.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
    server.sessions = {}
    lock = threading.Lock()

    @server.on_client_connect
    def begin(client: Any) -> None:
        server.sessions[client.client_id] = Session(client, scene, settings.expressions, lock)
        if client.client_id not in server.get_clients():  # already disconnected
            end(client)

    @server.on_client_disconnect
    def end(client: Any) -> None:
        session = server.sessions.pop(client.client_id, None)
        if session is not None:
            session.close()

    try:
        yield server
    finally:
        for session in list(server.sessions.values()):
            session.close()
        with redirect_stdout(io.StringIO()):
            server.stop()


def viser() -> Any:
    """The module. Raises `UnavailableError` if it is not installed."""
    try:
        return importlib.import_module("viser")
    except ImportError:
        text = "The viewer runs on viser, which is not installed."
        raise UnavailableError(text, install_extra("view")) from None


def check_port(port: int) -> None:
    """Raise `InputError` if a port is not free; viser would use another one."""
    try:
        with socket.socket() as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind((LOOPBACK, port))
    except OSError as error:
        remedy = "Choose another --port."
        raise InputError(
            "command line", "--port", "a port that is free", f"{port}: {error}", remedy
        ) from None
