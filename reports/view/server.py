"""The viewer's server: a session for each browser, on viser."""

from __future__ import annotations

import importlib
import io
import logging
import socket
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

from ...bench.contracts import Progress, no_progress
from ...bench.errors import InputError, UnavailableError, install_extra
from ...bench.specs import CommandResult, command
from .live import LOOPBACK, with_live_signal
from .scene import Scene, open_scene
from .session import Session
from .settings import ViewSettings

log = logging.getLogger(__name__)


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
    from .guard import token_required  # needs packages that come with viser

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
        raise UnavailableError(
            "The viewer runs on viser, which is not installed.", install_extra("view")
        ) from None


def check_port(port: int) -> None:
    """Raise `InputError` if a port is not free; viser would use another one."""
    try:
        with socket.socket() as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind((LOOPBACK, port))
    except OSError as error:
        raise InputError(
            "command line", "--port", "a port that is free", f"{port}: {error}", "Choose another --port."
        ) from None
