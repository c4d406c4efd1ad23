"""Which requests and messages the viewer's server accepts."""

import msgspec
import pytest

pytest.importorskip("viser")
from websockets.datastructures import Headers
from websockets.http11 import Request

from headbench.reports.view.guard import _MESSAGE, MAX_MESSAGE_BYTES, Guard

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 1.0),
    "fov": 0.8,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 600,
    "image_width": 800,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 1.0, 0.0),
}


def refusal(guard, path="/", **headers):
    named = {name.capitalize(): value for name, value in headers.items()}
    return guard.refusal(Request(path, Headers(named)))


@pytest.mark.parametrize(
    ("guard", "headers", "why"),
    [
        (Guard("127.0.0.1"), {"host": "127.0.0.1:8080"}, ""),
        (Guard("127.0.0.1"), {"host": "localhost:8080"}, ""),
        (Guard("127.0.0.1"), {"host": "[::1]:8080"}, ""),
        (Guard("127.0.0.1"), {"host": "localhost:8080", "origin": "http://localhost:8080"}, ""),
        (Guard("127.0.0.1"), {}, "another name"),
        (Guard("127.0.0.1"), {"host": "rebound.example:8080"}, "another name"),
        (Guard("127.0.0.1"), {"host": "localhost.example:8080"}, "another name"),
        (Guard("127.0.0.1"), {"host": "10.0.0.1:8080"}, "another name"),
        (Guard("127.0.0.1"), {"host": "[::1"}, "another name"),
        (Guard("127.0.0.1"), {"host": "localhost:8080", "origin": "http://evil.example"}, "other origins"),
        (Guard("127.0.0.1"), {"host": "localhost:8080", "origin": "http://localhost:9090"}, "other origins"),
        (Guard("127.0.0.1"), {"host": "localhost:8080", "origin": "null"}, "other origins"),
        (Guard("127.0.0.1", frozenset({"proxy.example"})), {"host": "proxy.example"}, ""),
        (Guard("0.0.0.0"), {"host": "192.168.1.5:8080"}, ""),
        (Guard("0.0.0.0"), {"host": "rebound.example:8080"}, "another name"),
    ],
)
def test_foreign_names_and_origins_are_refused(guard, headers, why):
    found = refusal(guard, **headers)
    assert why in found
    assert bool(found) == bool(why)


@pytest.mark.parametrize(
    ("path", "why"),
    [
        ("/secret/", ""),
        ("/secret/x.js?y", ""),
        ("/", "token"),
        ("/secre/", "token"),
        ("/x/secret/", "token"),
        ("secret", "token"),
    ],
)
def test_an_address_without_the_token_is_refused(path, why):
    guard = Guard("0.0.0.0", token="secret")
    assert guard.address(8080) == "http://0.0.0.0:8080/secret/"
    found = refusal(guard, path, host="192.168.1.5:8080")
    assert why in found
    assert bool(found) == bool(why)


def test_messages_of_the_page_are_read():
    assert _MESSAGE.decode(msgspec.msgpack.encode(CAMERA)).image_width == 800
    control = {"type": "GuiUpdateMessage", "uuid": "x", "updates": {"value": 0.5}}
    assert _MESSAGE.decode(msgspec.msgpack.encode(control)).updates == {"value": 0.5}


@pytest.mark.parametrize(
    "message",
    [
        {**CAMERA, "image_width": 1e12},
        {**CAMERA, "fov": float("nan")},
        {**CAMERA, "wxyz": (1.0, 0.0)},
        {"type": "GuiUpdateMessage", "uuid": "x", "updates": {"visible": False}},
        {"type": "GuiUpdateMessage", "uuid": "x" * 2000, "updates": {"value": 1}},
        {"type": "FileTransferStartUpload", "size": 1 << 40},
        {},
        [],
    ],
)
def test_other_messages_are_refused(message):
    data = msgspec.msgpack.encode(message)
    assert len(data) < MAX_MESSAGE_BYTES
    with pytest.raises(msgspec.MsgspecError):
        _MESSAGE.decode(data)
