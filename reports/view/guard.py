"""Access control of the viewer's server: host names, origins, the token, and limits on size and rate of messages.

viser has no settings for these; its server is based on the package websockets, which has. This module imports both.
"""

from __future__ import annotations

import asyncio
import hmac
import http
import ipaddress
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal
from unittest import mock
from urllib.parse import urlsplit

import msgspec
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from .settings import ViewSettings

MAX_MESSAGE_BYTES = 16 * 1024
"""The messages of viser's page have some hundred bytes."""
MAX_CONNECTIONS = 32
MAX_MESSAGES_PER_S = 200
"""During motion, the page sends one message for each image that it draws; faster senders are delayed."""

Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
"""A finite number."""
Numbers = Annotated[list[Number], msgspec.Meta(max_length=3)]
"""A list instead of a tuple: with a tuple in a union, msgspec 0.22 crashes in the garbage collector."""
Text = Annotated[str, msgspec.Meta(max_length=1000)]


class CameraMessage(msgspec.Struct, tag="ViewerCameraMessage", tag_field="type"):
    """The camera of a browser and the size of its canvas."""

    wxyz: tuple[Number, Number, Number, Number]
    position: tuple[Number, Number, Number]
    fov: Number
    near: Number
    far: Number
    image_height: Number
    image_width: Number
    look_at: tuple[Number, Number, Number]
    up_direction: tuple[Number, Number, Number]


class ControlMessage(msgspec.Struct, tag="GuiUpdateMessage", tag_field="type"):
    """The new value of a control. viser would also set any other attribute of it."""

    uuid: Text
    updates: dict[Literal["value"], bool | Number | Text | Numbers]


_MESSAGE = msgspec.msgpack.Decoder(CameraMessage | ControlMessage)

_HEADERS = {
    "Content-Security-Policy": "frame-ancestors 'none'",  # prevents clickjacking
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",  # the address holds the token
    "X-Content-Type-Options": "nosniff",
}


class GuardedConnection(ServerConnection):
    """A connection that passes on to viser only messages of the viewer's page, at its maximum rate.

    Browsers that send anything else are disconnected with the reason. viser would also handle other messages, such as uploads,
    which it keeps in memory, and messages to all other browsers.
    """

    _messages = 0
    _since = 0.0

    async def recv(self, decode: bool | None = None) -> Any:
        """The next message."""
        raw = await super().recv(decode)
        self._messages += 1
        if self._messages > MAX_MESSAGES_PER_S:
            await asyncio.sleep(max(0.0, self._since + 1.0 - time.monotonic()))
        if time.monotonic() - self._since >= 1.0:
            self._messages, self._since = 0, time.monotonic()
        try:
            if not isinstance(raw, bytes):
                raise msgspec.ValidationError("a message of text")
            _MESSAGE.decode(raw)
        except (msgspec.MsgspecError, RecursionError) as error:
            await self.close(1008, f"refused: {error}"[:100])
            raise self.protocol.close_exc from error
        return raw


@dataclass(frozen=True)
class Guard:
    """Decides which requests are answered.

    Attributes
    ----------
    host : str
        The address that the server listens at.
    names : frozenset[str]
        Host names that requests may have besides those of the loopback interface and ``host``.
    token : str
        First part of the path of every request; "" for none.
    """

    host: str
    names: frozenset[str] = frozenset()
    token: str = field(default="", repr=False)

    @classmethod
    def of(cls, settings: ViewSettings) -> Guard:
        """The guard of a server with these settings, with a new token unless only this machine can connect."""
        token = "" if is_loopback(settings.host) else secrets.token_urlsafe(24)
        return cls(settings.host, frozenset(name.lower() for name in settings.allowed_hosts), token)

    def address(self, port: int) -> str:
        """The address to open, with the token."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{port}" + (f"/{self.token}/" if self.token else "")

    def refusal(self, request: Request) -> str:
        """Reason for refusing a request; "" if it is accepted.

        A page of another site can send requests here from a browser on this machine. Its own name stands in ``Origin``, or, if
        its name was made to resolve to this machine's address (DNS rebinding), in ``Host``. Programs send no ``Origin``.
        """
        hosts = request.headers.get_all("Host")
        if len(hosts) != 1 or not self._accepts(hosts[0]):
            return "The server has another name. Open the address that was printed, or start it with --allowed-hosts NAME."
        for origin in request.headers.get_all("Origin"):
            if origin.lower() not in (f"http://{hosts[0]}".lower(), f"https://{hosts[0]}".lower()):
                return "Pages of other origins cannot use the viewer."
        if self.token:
            given = request.path.partition("?")[0].split("/")[1:2]
            if not hmac.compare_digest("".join(given).encode(), self.token.encode()):
                return "The address lacks the token. Open the address that was printed."
        return ""

    def _accepts(self, host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        if name == self.host.lower() or name in self.names or is_loopback(name):
            return True
        # DNS rebinding needs a host name, so numeric addresses are safe; this may be any address of this machine.
        return _is_wildcard(self.host) and _address(name) is not None

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Every server of websockets that starts in this context has the guard. Raises `RuntimeError` if none starts."""
        serve = websockets.asyncio.server.serve
        started = []

        def guarded(*args: Any, process_request: Any, **options: Any) -> Any:
            def process(connection: ServerConnection, request: Request) -> Response | None:
                why = self.refusal(request)
                if why:
                    return connection.respond(http.HTTPStatus.FORBIDDEN, why + "\n")
                if len(connection.server.connections) >= MAX_CONNECTIONS:
                    return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "Too many browsers.\n")
                request.path = request.path[len(self.token) + 1 :] if self.token else request.path
                response = process_request(connection, request)
                if isinstance(response, Response):
                    response.headers.update(_HEADERS)
                return response if isinstance(response, Response) else None

            started.append(True)
            changed = {"create_connection": GuardedConnection, "max_size": MAX_MESSAGE_BYTES}
            return serve(*args, process_request=process, **(options | changed))

        with mock.patch.object(websockets.asyncio.server, "serve", guarded):
            yield
        if not started:
            raise RuntimeError("viser started its server in a way that is not known here, without the guard")


def is_loopback(host: str) -> bool:
    """Whether a host name or address belongs to the loopback interface."""
    address = _address(host)
    return host == "localhost" if address is None else address.is_loopback


def _is_wildcard(host: str) -> bool:
    address = _address(host)
    return host == "" or (address is not None and address.is_unspecified)


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None
