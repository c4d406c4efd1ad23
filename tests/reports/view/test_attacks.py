"""Hostile clients of a running viewer are refused, and others are drawn for."""

import http.client
import threading
import time
from contextlib import suppress
from io import BytesIO

import pytest
from PIL import Image

viser = pytest.importorskip("viser", reason="viser is not installed")
import msgspec
import zstandard
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.sync.client import connect

from headbench.reports.view import guard
from headbench.reports.view.server import serving
from headbench.reports.view.session import MOST_HEIGHT, MOST_WIDTH
from headbench.reports.view.settings import ViewSettings

from .test_guard import CAMERA


@pytest.fixture
def server(scene):
    with serving(scene, ViewSettings(("run",), port=0, expressions=2)) as server:
        yield server


def client(server, **changes):
    return connect(
        f"ws://127.0.0.1:{server.get_port()}",
        **{"subprotocols": [f"viser-v{viser.__version__}"], "max_size": None, "close_timeout": 1, **changes},
    )


def send(connection, **message):
    connection.send(msgspec.msgpack.encode(message))


def pictures(connection, seconds=60.0):
    """Pictures that arrive, as (width, height)."""
    until = time.monotonic() + seconds
    while (left := until - time.monotonic()) > 0:
        raw = connection.recv(timeout=left)
        size, packed = (int.from_bytes(raw[start : start + 8], "little") for start in (0, 8))
        packed_end = 16 + packed
        head = zstandard.ZstdDecompressor().decompress(raw[16:packed_end], max_output_size=size)
        message = msgspec.msgpack.decode(head)
        start = -(-packed_end // 8) * 8
        buffers = []
        for length in message["binaryBufferLengths"]:
            start = -(-start // 8) * 8
            buffers.append(raw[start : start + length])
            start += length
        for part in message["messages"]:
            if part["type"] == "BackgroundImageMessage" and part["rgb_data"] is not None:
                data = part["rgb_data"]
                data = buffers[data["__binary_index"]] if isinstance(data, dict) else data
                yield Image.open(BytesIO(data)).size


def test_pages_of_other_origins_and_names_are_refused(server):
    for changes in (
        {"origin": "http://evil.example"},
        {"additional_headers": {"Host": "rebound.example"}},
    ):
        with pytest.raises(InvalidStatus, match="403"):
            client(server, **changes)
    for host, status in (("rebound.example", 403), ("localhost", 200)):
        connection = http.client.HTTPConnection("127.0.0.1", server.get_port())
        connection.request("GET", "/", headers={"Host": host})
        assert connection.getresponse().status == status


@pytest.mark.parametrize("size", [(200_000, 1080), (200_000, 200_000), (10**9, 1)])
def test_a_huge_canvas_is_bounded(server, size):
    with client(server) as hostile, client(server) as other:
        send(hostile, **{**CAMERA, "image_width": size[0], "image_height": size[1]})
        width, height = next(pictures(hostile))
        assert width <= MOST_WIDTH
        assert height <= MOST_HEIGHT + 100  # panels are at least some pixels high, with a label above
        send(other, **{**CAMERA, "image_width": 120, "image_height": 90})
        assert max(next(pictures(other))) < 500


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (msgspec.msgpack.encode({**CAMERA, "fov": float("nan")}), 1008),
        (msgspec.msgpack.encode({"type": "FileTransferStartUpload", "part_count": 10**9}), 1008),
        (msgspec.msgpack.encode({"type": "GuiFormDirtyMessage", "uuid": "x"}), 1008),
        (b"\x91" * 10_000, 1008),
        ("text", 1008),
        (b"x" * (guard.MAX_MESSAGE_BYTES + 1), 1009),
    ],
    ids=["nan", "upload", "to all", "deep", "text", "long"],
)
def test_a_bad_message_ends_its_client_alone(server, data, code):
    with client(server) as hostile, client(server) as other:
        send(other, **{**CAMERA, "image_width": 120, "image_height": 90})
        assert next(pictures(other))
        hostile.send(data)
        with suppress(ConnectionClosedError):
            for _ in hostile:
                pass
        assert hostile.close_code == code
        send(other, **{**CAMERA, "image_width": 150, "image_height": 90})
        assert next(pictures(other))


def drawing():
    """Threads of sessions."""
    return [thread for thread in threading.enumerate() if "Session" in repr(getattr(thread, "_target", ""))]


def test_browsers_that_come_and_go_leave_no_session(server):
    for _ in range(20):
        with client(server) as connection:
            send(connection, **CAMERA)
    until = time.monotonic() + 60
    while (server.sessions or server.get_clients() or drawing()) and time.monotonic() < until:
        time.sleep(0.1)
    assert not server.sessions
    assert not drawing()


def test_more_connections_than_allowed_are_refused(server, monkeypatch):
    monkeypatch.setattr(guard, "MAX_CONNECTIONS", 2)
    with client(server), client(server), pytest.raises(InvalidStatus, match="503"):
        client(server)


def test_a_sender_of_many_messages_waits(server, monkeypatch):
    monkeypatch.setattr(guard, "MAX_MESSAGES_PER_S", 5)
    with client(server) as hostile:
        for number in range(60):
            send(hostile, **{**CAMERA, "fov": 0.8 + number / 1000})
        time.sleep(1.0)
        handled = [state.fov for state in (c.camera for c in server.get_clients().values())]
        assert handled
        assert max(handled) < 0.83


def test_the_token_is_in_the_address_of_other_interfaces(scene):
    with serving(scene, ViewSettings(("run",), host="0.0.0.0", port=0, expressions=2)) as server:
        token = server.address.rstrip("/").rpartition("/")[2]
        assert len(token) > 20
        with pytest.raises(InvalidStatus, match="403"):
            client(server)
        with connect(f"{server.address.replace('http', 'ws')}", subprotocols=[f"viser-v{viser.__version__}"]):
            pass
