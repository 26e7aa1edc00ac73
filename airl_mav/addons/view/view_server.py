"""View process: draws snapshots for all viewers and returns their requests.

The first line of its input is a `ViewSettings`, the first line of its output a `ViewAnswer`. The
process ends with the run, at the end of its input.
"""

from __future__ import annotations

import os
import re
import sys
import threading
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from airl_mav.addons.view.panel import Panel
from airl_mav.addons.view.view_messages import Shown, Steering, ViewAnswer, ViewSettings
from airl_mav.addons.view.viewer import Ends
from airl_mav.addons.view.viser_scene import FlightScene
from airl_mav.core.clock import WallClock
from airl_mav.core.constants import LOOPBACK, US_PER_S
from airl_mav.core.scheduling import give_way

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


FASTEST = "fastest"
SPEEDS = {"0.1 x": 0.1, "0.25 x": 0.25, "0.5 x": 0.5, "1 x": 1.0, "2 x": 2.0, "5 x": 5.0}
"""Speeds offered besides the scenario's speed and the fastest."""

LONGEST_MS = 1000
"""Maximum latency of the slider [ms]."""

FIRST_MS = 400
"""Initial latency of the slider [ms]: the paper's Raspberry Pi 4."""


class Controls:
    """Controls of one page; their callbacks are coroutines, run before the next message."""

    def __init__(self, gui: Any, steering: Steering) -> None:
        """Store viser's interface and the initial requests."""
        self.steering = steering
        """Current requests of the viewers."""
        self._gui = gui

    def _ask(self, **changes: Any) -> None:
        self.steering = self.steering.model_copy(update=changes)

    def let_go(self) -> None:
        """Resume a paused flight after the last viewer disconnects."""
        self._ask(paused=False)

    def add_pace(self) -> None:
        """Add the controls of the pace."""
        gui = self._gui
        speeds = dict(SPEEDS)
        if (speed := self.steering.speed) is not None and speed not in speeds.values():
            speeds[f"{speed:g} x"] = speed
        named = {value: name for name, value in speeds.items()}
        first = FASTEST if speed is None else named[speed]
        pause = gui.add_button_group("Flight", ("Pause", "Step", "Go on"))
        pace = gui.add_dropdown("Speed", (*speeds, FASTEST), initial_value=first)

        @pause.on_click
        async def _(_event: object) -> None:
            if pause.value == "Go on":
                self._ask(paused=False)
            elif pause.value == "Pause":
                self._ask(paused=True)
            else:
                self._ask(paused=True, steps=self.steering.steps + 1)

        @pace.on_update
        async def _(_event: object) -> None:
            self._ask(speed=speeds.get(pace.value))

    def add_knob(self, *, compensable: bool, compensated: bool) -> None:
        """Add the latency control and, if the vehicle supports it, the compensation control."""
        gui = self._gui
        by_hand = gui.add_checkbox(
            "Set t2 by hand", False, hint="The flight then counts in no statistics."
        )
        t2 = gui.add_slider("t2 [ms]", 0, LONGEST_MS, 10, FIRST_MS, disabled=True)

        async def changed(_event: object) -> None:
            t2.disabled = not by_hand.value
            self._ask(t2_ms=float(t2.value) if by_hand.value else None)

        by_hand.on_update(changed)
        t2.on_update(changed)
        if not compensable:
            return
        switch = gui.add_checkbox(
            "Compensate", compensated, hint="Changed, the flight counts in no statistics."
        )

        @switch.on_update
        async def _(_event: object) -> None:
            self._ask(compensate=None if switch.value == compensated else bool(switch.value))


DRAW_US = 33_333
"""Period of scene updates [wall µs]."""

PICTURE_EVERY, PANEL_EVERY, STRIP_EVERY = 3, 4, 8
"""Scene updates per update of the camera's image, the panel and the strip."""

NICENESS = 10
"""Nice value of the view; flights have priority on a busy machine."""


class RunPage:
    """Page of a run."""

    def __init__(self, server: viser.ViserServer, ends: Ends, request: ViewSettings) -> None:
        """Build the page."""
        self._server, self._ends = server, ends
        self._shown = Shown()
        self._scene = FlightScene(server)
        self._controls = controls = Controls(server.gui, Steering(speed=request.speed))
        knob = partial(
            controls.add_knob, compensable=request.compensable, compensated=request.compensated
        )
        head = controls.add_pace if request.paced else lambda: None
        self._panel = Panel(server, request.run, head=head, latency=knob)
        self._watchers = Watchers(server, controls.let_go)
        self._drawn = 0

    def run(self, ended: threading.Event) -> None:
        """Draw until the run has ended."""
        clock = WallClock()
        due_us = 0
        while not ended.is_set():
            self._ends.ask(self._controls.steering)
            left_s = max(0.0, (due_us - clock.time_us()) / US_PER_S)
            for message, depth_mm in self._ends.take(left_s):
                self._shown.take(message, depth_mm)
            now_us = clock.time_us()
            if now_us < due_us:
                continue
            # Counted from the due time, so that the drawing time does not lengthen the period.
            due_us = max(due_us, now_us - DRAW_US) + DRAW_US
            if self._watchers.there:
                self._draw()

    def _draw(self) -> None:
        self._drawn += 1
        self._scene.draw(self._shown, picture=self._drawn % PICTURE_EVERY == 0)
        if self._drawn % PANEL_EVERY == 0:
            self._panel.draw(self._shown)
        if self._drawn % STRIP_EVERY == 0:
            self._panel.draw_strip(self._shown)
        self._watchers.follow(self._shown)


def main() -> int:
    """Run a view until the input ends."""
    outgoing = os.fdopen(os.dup(1), "wb", buffering=0)
    # Output of libraries must not reach the harness as an answer.
    os.dup2(2, 1)
    request = ViewSettings.model_validate_json(sys.stdin.buffer.readline())
    give_way(NICENESS)
    warnings.simplefilter("ignore", DeprecationWarning)
    server = LocalServer(request.port or 0)
    port = server.get_port()
    if request.port not in (None, port):
        outgoing.write(ViewAnswer().model_dump_json().encode() + b"\n")
        return 0
    ends = Ends()
    outgoing.write(ViewAnswer(port=port, ends=ends.ends).model_dump_json().encode() + b"\n")
    ended = threading.Event()

    def listen() -> None:
        while os.read(0, 4096):
            pass
        ended.set()

    threading.Thread(target=listen, name="harness", daemon=True).start()
    RunPage(server, ends, request).run(ended)
    server.stop()
    ends.close()
    return 0


CHASE = np.array([-5.0, 0.0, -3.2])
"""Initial camera offset from the vehicle, NED [m]."""


class Watchers:
    """Viewers of one server."""

    def __init__(
        self, server: viser.ViserServer, deserted: Callable[[], None] = lambda: None
    ) -> None:
        """Register for connections; `deserted` is called when the last viewer disconnects."""
        self._server = server
        self._deserted = deserted
        self._following: dict[int, Any] = {}
        """Checkbox "Follow the vehicle" of each client."""
        server.initial_camera.position, server.initial_camera.look_at = CHASE, np.zeros(3)
        server.on_client_connect(self._welcome)
        server.on_client_disconnect(self._part)

    @property
    def there(self) -> bool:
        """True if at least one client is connected."""
        return bool(self._server.get_clients())

    def expect(self, shown: Shown) -> None:
        """Set the initial camera of new pages so that the vehicle is visible."""
        if shown.vehicle is None:
            return
        at = np.array(shown.vehicle.position)
        begin = self._server.initial_camera
        begin.position, begin.look_at = at + CHASE, at

    def follow(self, shown: Shown) -> None:
        """Move the following cameras with the vehicle."""
        if shown.vehicle is None:
            return
        at = np.array(shown.vehicle.position)
        for number, client in self._server.get_clients().items():
            switch, camera = self._following.get(number), client.camera
            if switch is not None and switch.value:
                # A viewer may have rotated or zoomed the camera.
                offset = camera.position - camera.look_at
                with client.atomic():
                    camera.position, camera.look_at = at + offset, at

    def _welcome(self, client: viser.ClientHandle) -> None:
        switch = client.gui.add_checkbox("Follow the vehicle", True, order=-1.0)
        self._following[client.client_id] = switch

    def _part(self, client: viser.ClientHandle) -> None:
        self._following.pop(client.client_id, None)
        if not self.there:
            self._deserted()


if __name__ == "__main__":
    sys.exit(main())
