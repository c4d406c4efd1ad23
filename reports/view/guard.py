"""Access to the viewer's server: only requests whose path starts with a random token are answered.

viser has no setting for this; its server is based on the package websockets, which has.
"""

from __future__ import annotations

import hmac
import http
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response


@contextmanager
def token_required() -> Iterator[str]:
    """Servers of websockets that start in this context refuse requests without the returned token.

    Pages of other sites can send requests to this machine from its browsers, and other users of it too; neither know the token.
    Raises `RuntimeError` if no server starts.
    """
    token, started = secrets.token_urlsafe(24), []
    serve = websockets.asyncio.server.serve

    def guarded(*args: Any, process_request: Any, **options: Any) -> Any:
        def process(connection: ServerConnection, request: Request) -> Response | None:
            first, _, rest = request.path.removeprefix("/").partition("/")
            if not hmac.compare_digest(first.encode(), token.encode()):
                text = "The address lacks the token. Open the address that was printed.\n"
                return connection.respond(http.HTTPStatus.FORBIDDEN, text)
            request.path = f"/{rest}"
            response: Response | None = process_request(connection, request)
            return response

        started.append(True)
        return serve(*args, process_request=process, **options)

    with mock.patch.object(websockets.asyncio.server, "serve", guarded):
        yield token
    if not started:
        raise RuntimeError("viser started its server in a way that is not known here, without the token")
