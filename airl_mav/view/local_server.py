"""viser's server restricted to pages of this computer.

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

from airl_mav.core.ports import LOOPBACK

OWN_PAGES = [re.compile(r"http://(127\.0\.0\.1|localhost)(:\d+)?"), None]
"""Whose pages may connect: those that this computer serves, and programs, which name no origin."""

Answering = Callable[[ServerConnection, Request], Response | None]
"""Answers a request, or leaves it to the WebSocket: None."""


def uncompressed(answering: Answering) -> Answering:
    """Return the handler without compression, which only slows viser's page on one computer."""

    def answer(connection: ServerConnection, request: Request) -> Response | None:
        if "Accept-Encoding" in request.headers:
            del request.headers["Accept-Encoding"]
        return answering(connection, request)

    return answer


class LocalServer(viser.ViserServer):
    """A server on the loopback address that no other site's page reaches and nobody publishes."""

    def __init__(self, port: int) -> None:
        """Serve on a port, 0 for a free one; where it is taken, on another."""
        module: Any = websockets.asyncio.server
        serve = module.serve

        def serve_locally(*words: Any, process_request: Answering, **more: Any) -> Any:
            answering = uncompressed(process_request)
            return serve(*words, origins=OWN_PAGES, process_request=answering, **more)

        # viser has no option for it. It listens before its constructor returns.
        module.serve = serve_locally
        try:
            super().__init__(LOOPBACK, port, verbose=False)
        finally:
            module.serve = serve

    def request_share_url(self, verbose: bool = True) -> None:
        """Open no tunnel, whoever asks."""
