"""A live signal: lines on a port of this machine or standard input become poses; others are refused."""

import http.client
import io
import json
import socket
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.reports.view import server as module
from headbench.reports.view.scene import ViewSettings
from headbench.reports.view.server import LivePoses, local_port, standard_input

pytest.importorskip("viser", reason="viser is not installed")
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from headbench.reports.view.server import serving, token_required


@pytest.fixture(scope="module")
def server():
    with serving(None, ViewSettings(("run",), port=0)) as server:
        yield server


@pytest.mark.parametrize(
    ("path", "status"), [("/{}/", 200), ("/", 403), ("/wrong/", 403), ("/wrong/{}/", 403), ("/{}x/", 403)]
)
def test_a_request_needs_the_token(server, path, status):
    token = server.address.split("/")[3]
    assert len(token) > 20
    connection = http.client.HTTPConnection("127.0.0.1", server.get_port())
    connection.request("GET", path.format(token))
    assert connection.getresponse().status == status
    connection.close()


def test_a_connection_needs_the_token(server):
    with pytest.raises(InvalidStatus, match="403"):
        connect(f"ws://127.0.0.1:{server.get_port()}/")


def test_a_server_without_the_token_is_an_error():
    with pytest.raises(RuntimeError, match="without the token"), token_required():
        pass


def driver(line):
    frame = json.loads(line)
    if "wrong" in frame:
        raise InputError("live signal", "wrong", "a frame", "none")
    return frame["n"]


@pytest.fixture
def live():
    made = LivePoses({"one": driver, "other": lambda line: -driver(line)})
    yield made
    made.close()


def eventually(condition):
    ends = time.monotonic() + 20
    while not condition() and time.monotonic() < ends:
        time.sleep(0.01)
    return condition()


def send(port, *lines):
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(b"".join(line.encode() + b"\n" for line in lines))


def test_lines_on_a_port_become_poses_of_every_head_model(live):
    heard = threading.Event()
    live.listen(heard.set)
    assert live.pose("one") is None
    with local_port(live, 0) as port:
        send(port, '{"n": 1}', "", '{"n": 2}')
        assert eventually(lambda: live.pose("one") == 2)
        assert heard.wait(20)
        assert live.pose("other") == -2
        send(port, '{"n": 3}')  # after the first program has gone
        assert eventually(lambda: live.pose("one") == 3)


def test_only_this_machine_is_listened_to(live, monkeypatch):
    asked = []
    create = socket.create_server
    monkeypatch.setattr(module.socket, "create_server", lambda *a, **o: asked.append(a[0]) or create(*a, **o))
    with local_port(live, 0):
        pass
    assert [host for host, _ in asked] == ["127.0.0.1"]


def test_a_browsers_request_ends_its_connection(live):
    with local_port(live, 0) as port:
        send(port, "POST / HTTP/1.1", "Host: localhost", "", '{"n": 9}')
        send(port, '{"n": 4}')
        assert eventually(lambda: live.pose("one") == 4)


def test_a_line_of_no_frame_is_told_once_and_passed_over(live, caplog):
    with local_port(live, 0) as port:
        for _ in range(3):
            send(port, '{"wrong": 1}')
            assert eventually(lambda: live._line is None)
        send(port, '{"n": 5}')
        assert eventually(lambda: live.pose("one") == 5)
    assert sum("live signal, wrong" in record.message for record in caplog.records) == 1


def test_standard_input_is_read(live, monkeypatch):
    monkeypatch.setattr(module.sys, "stdin", SimpleNamespace(buffer=io.BytesIO(b'{"n": 6}\n')))
    with standard_input(live):
        assert eventually(lambda: live.pose("one") == 6)


def test_a_taken_port_is_refused(live):
    with local_port(live, 0) as port, pytest.raises(InputError, match="--live"), local_port(live, port):
        pass


@pytest.mark.parametrize("value", ["0", "65536", "localhost:1", "x"])
def test_settings_take_a_port_or_a_dash(value):
    assert ViewSettings(("run",), live="-").live == "-"
    with pytest.raises(ValueError, match="live is"):
        ViewSettings(("run",), live=value)


@pytest.mark.parametrize("method", ["ga", "gbs"])
def test_avatars_show_the_poses_of_lines(scene, method):
    from dataclasses import replace

    from headbench.datasets.drive.transfer import LiveDriver
    from headbench.reports.view.scene import LIVE, State
    from headbench.reports.view.session import pose_of

    shown = next(one for one in scene.shown if one.label == method)
    made = LivePoses({shown.version: LiveDriver(shown.form.clip.head, "avatar")})
    try:
        avatar, state = replace(shown, live=made), State(recording=LIVE)
        neutral = pose_of(avatar, state, None)
        assert not neutral.jaw.any()
        made.put(json.dumps({"expression": [0.5, -0.25], "jaw": [0.2, 0, 0]}))
        assert eventually(lambda: made.pose(shown.version) is not None)
        pose = pose_of(avatar, state, None)
        assert pose.jaw == pytest.approx([0.2, 0, 0])
        assert pose.expression[:3] == pytest.approx([0.5, -0.25, 0])
        camera = next(iter(shown.form.clip.cameras.values()))
        assert np.isfinite(avatar.avatar.render(camera, pose).rgb).all()
    finally:
        made.close()
