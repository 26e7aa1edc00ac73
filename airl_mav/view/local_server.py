"""Server of viser restricted to pages of this computer.

Any web page may open a WebSocket to 127.0.0.1, with its `Origin`. viser accepts all of them and
opens public tunnels on request. A foreign page could change flights or publish them.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from airl_mav.core.constants import LOOPBACK

OWN_PAGES = [re.compile(r"http://(127\.0\.0\.1|localhost)(:\d+)?"), None]
"""Accepted origins: pages served by this computer, and programs, which send no origin."""

Answering = Callable[[ServerConnection, Request], Response | None]
"""Handler of HTTP requests; returns None to continue with the WebSocket."""


def uncompressed(answering: Answering) -> Answering:
    """Return the handler without compression, which only slows viser's page on loopback."""

    def answer(connection: ServerConnection, request: Request) -> Response | None:
        if "Accept-Encoding" in request.headers:
            del request.headers["Accept-Encoding"]
        return answering(connection, request)

    return answer


class LocalServer(viser.ViserServer):
    """Server on the loopback address that rejects other sites' pages and public tunnels."""

    def __init__(self, port: int) -> None:
        """Serve on a port, 0 = any free port; a port in use is replaced by another."""
        module: Any = websockets.asyncio.server
        serve = module.serve

        def serve_locally(*words: Any, process_request: Answering, **more: Any) -> Any:
            answering = uncompressed(process_request)
            return serve(*words, origins=OWN_PAGES, process_request=answering, **more)

        # viser has no option for origins, and listens before its constructor returns.
        module.serve = serve_locally
        try:
            super().__init__(LOOPBACK, port, verbose=False)
        finally:
            module.serve = serve

    def request_share_url(self, verbose: bool = True) -> None:
        """Ignore requests for a public tunnel."""
