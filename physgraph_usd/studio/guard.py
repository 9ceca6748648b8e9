"""Access to the page: for nobody without the secret in its address, and for no page of another site."""

from __future__ import annotations

import dataclasses
import http
import io
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from typing import Any

import viser
import websockets.asyncio.server as sockets
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from ..errors import UsageError

ADDRESS = "127.0.0.1"
"""Where the page is served: on this machine alone."""
_NAMES = (ADDRESS, "localhost")


class Guard:
    """A check of every request and websocket handshake, before the viewer sees it.

    Attributes:
        token: The secret, the first part of every path.
        is_asked: Whether a server was made that asks this guard.
    """

    def __init__(self) -> None:
        """Draw a secret."""
        self.token, self.is_asked = secrets.token_urlsafe(16), False

    def refusal(self, request: Request) -> str | None:
        """The reason to refuse a request; None to accept."""
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        if len(hosts) != 1 or hosts[0].partition(":")[0] not in _NAMES:
            return "another host"
        if any(origin != f"http://{hosts[0]}" for origin in origins):
            return "a page of another site"
        first = request.path.partition("?")[0].split("/")[1:2]
        if not first or not secrets.compare_digest(first[0].encode(), self.token.encode()):
            return "the address lacks its secret; open the one that physgraph-usd tune printed"
        return None

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Have every server that is made inside ask the guard; the viewer has no hook of its own for that."""
        serve = sockets.serve

        def guarded(*args: Any, process_request: Callable[..., Response | None], **kwargs: Any) -> sockets.serve:
            def asked(connection: sockets.ServerConnection, request: Request) -> Response | None:
                why = self.refusal(request)
                if why is not None:
                    status = http.HTTPStatus.FORBIDDEN
                    text = f"refused: {why}\n".encode()
                    headers = Headers({"Content-Type": "text/plain", "Content-Length": str(len(text))})
                    return Response(status, status.phrase, headers, text)
                within = request.path.removeprefix(f"/{self.token}") or "/"
                return process_request(connection, dataclasses.replace(request, path=within))

            self.is_asked = True
            return serve(*args, process_request=asked, **kwargs)

        sockets.serve = guarded  # pyright: ignore[reportAttributeAccessIssue]
        try:
            yield
        finally:
            sockets.serve = serve


def guarded_server(*, port: int, label: str) -> tuple[viser.ViserServer, str]:
    """A viewer on this machine, at this port or the next free one, and its address, which alone opens it.

    Raises:
        UsageError: The viewer is of a version that cannot be guarded.
    """
    guard = Guard()
    with guard.watching(), redirect_stdout(io.StringIO()):  # Its banner, which has an address without the secret.
        server = viser.ViserServer(host=ADDRESS, port=port, label=label, verbose=False)
    if not guard.is_asked:
        server.stop()
        raise UsageError(f"viser {viser.__version__} cannot be kept from other pages; install a viser of 1.1")
    return server, f"http://{ADDRESS}:{server.get_port()}/{guard.token}"
