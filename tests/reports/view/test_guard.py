"""The viewer answers only requests whose path starts with its token."""

import http.client

import pytest

pytest.importorskip("viser", reason="viser is not installed")
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from headbench.reports.view.scene import ViewSettings
from headbench.reports.view.server import serving, token_required


@pytest.fixture(scope="module")
def server():
    with serving(None, ViewSettings(("run",), port=0)) as server:
        yield server


@pytest.mark.parametrize(
    ("path", "status"),
    [("/{}/", 200), ("/", 403), ("/wrong/", 403), ("/wrong/{}/", 403), ("/{}x/", 403)],
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
