"""Access to the page: for nobody without the secret in its address, and for no page of another site."""

from __future__ import annotations

import dataclasses
import http
import io
import re
import secrets
from collections.abc import Callable
from contextlib import redirect_stdout
from typing import Any

import viser
import websockets.asyncio.server as sockets
from websockets.http11 import Request, Response

from ..errors import UsageError

ADDRESS = "127.0.0.1"
"""Where the page is served: on this machine alone."""
_HOST = re.compile(rf"({re.escape(ADDRESS)}|localhost)(:\d+)?")


def _refusal(request: Request, token: str) -> str | None:
    """The reason to refuse a request whose path must begin with a secret; None to accept."""
    hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
    if len(hosts) != 1 or not _HOST.fullmatch(hosts[0]):
        return "another host"
    if any(origin != f"http://{hosts[0]}" for origin in origins):
        return "a page of another site"
    first = request.path.partition("?")[0].split("/")[1:2]
    if not first or not secrets.compare_digest(first[0].encode(), token.encode()):
        return "the address lacks its secret; open the one that physgraph-usd tune printed"
    return None


def guarded_server(*, port: int, label: str) -> tuple[viser.ViserServer, str]:
    """A viewer on this machine, at a port or the next free one, and the only URL that opens the viewer.

    viser has no hook to check requests, so its websocket server is replaced: every request and handshake is checked.

    Raises:
        UsageError: The viewer is of a version that cannot be guarded.
    """
    token, serve, asked = secrets.token_urlsafe(16), sockets.serve, list[None]()

    def guarded(*args: Any, process_request: Callable[..., Response | None], **kwargs: Any) -> sockets.serve:
        def check(connection: sockets.ServerConnection, request: Request) -> Response | None:
            why = _refusal(request, token)
            if why is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"refused: {why}\n")
            within = request.path.removeprefix(f"/{token}") or "/"
            return process_request(connection, dataclasses.replace(request, path=within))

        asked.append(None)
        return serve(*args, process_request=check, **kwargs)

    sockets.serve = guarded  # pyright: ignore[reportAttributeAccessIssue]
    try:
        with redirect_stdout(io.StringIO()):  # Its banner, which has an address without the secret.
            server = viser.ViserServer(host=ADDRESS, port=port, label=label, verbose=False)
    finally:
        sockets.serve = serve
    if not asked:
        server.stop()
        raise UsageError(f"viser {viser.__version__} cannot be kept from other pages; install a viser of 1.1")
    return server, f"http://{ADDRESS}:{server.get_port()}/{token}"
