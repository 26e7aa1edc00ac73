"""viser's server, for pages of this computer alone.

A browser lets every web page open a WebSocket to 127.0.0.1, and says in its `Origin` whose page it
is. viser takes any, and opens a public tunnel to itself when one asks: a page that is open beside
the view could pause flights, change their latency, or show them to the internet.
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
