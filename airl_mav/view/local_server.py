"""viser's server, for pages of this computer alone.

A browser lets every web page open a WebSocket to 127.0.0.1, and says in its `Origin` whose page it
is. viser takes any, and opens a public tunnel to itself when one asks: a page that is open beside
the view could pause flights, change their latency, or show them to the internet.
"""

from __future__ import annotations

import re
from functools import partial
from typing import Any

import viser
import websockets.asyncio.server

from airl_mav.core.ports import LOOPBACK

OWN_PAGES = [re.compile(r"http://(127\.0\.0\.1|localhost)(:\d+)?"), None]
"""Whose pages may connect: those that this computer serves, and programs, which name no origin."""


class LocalServer(viser.ViserServer):
    """A server on the loopback address that no other site's page reaches and nobody publishes."""

    def __init__(self, port: int) -> None:
        """Serve on a port, 0 for a free one; where it is taken, on another."""
        module: Any = websockets.asyncio.server
        serve = module.serve
        # viser has no option for it. It listens before its constructor returns.
        module.serve = partial(serve, origins=OWN_PAGES)
        try:
            super().__init__(LOOPBACK, port, verbose=False)
        finally:
            module.serve = serve

    def request_share_url(self, verbose: bool = True) -> None:
        """Open no tunnel, whoever asks."""
