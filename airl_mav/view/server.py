"""The view's process: takes snapshots in, draws them for all who watch, says what they ask for.

Its first line of input is a `Request`, its first line of output an `Answer`. It ends when its
input does: with the run.
"""

from __future__ import annotations

import os
import sys
import threading
import warnings
from functools import partial

import viser

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.scheduling import give_way
from airl_mav.view.controls import Controls
from airl_mav.view.feed import Ends
from airl_mav.view.handshake import Answer, Request
from airl_mav.view.local_server import LocalServer
from airl_mav.view.messages import Steering
from airl_mav.view.panel import Panel
from airl_mav.view.scene import FlightScene
from airl_mav.view.shown import Shown
from airl_mav.view.watchers import Watchers

DRAW_US = 33_333
"""Time between two drawings of the scene [wall µs]."""

PICTURE_EVERY, PANEL_EVERY, STRIP_EVERY = 3, 4, 8
"""Drawings of the scene for one of the camera's image, of the panel, of the strip."""

NICENESS = 10
"""Less than that of flights: on a busy machine it is the view that waits."""


class View:
    """The page of a run."""

    def __init__(self, server: viser.ViserServer, ends: Ends, request: Request) -> None:
        """Build the page."""
        self._server, self._ends = server, ends
        self._shown = Shown()
        self._scene = FlightScene(server)
        self._controls = controls = Controls(server.gui, Steering(speed=request.speed))
        knob = partial(
            controls.add_knob,
            compensable=request.compensable,
            compensated=request.compensated,
        )
        head = controls.add_pace if request.paced else lambda: None
        latency = knob if request.steerable else lambda: None
        self._panel = Panel(server, request.run, head=head, latency=latency)
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
            # Counted from when it was due, or what drawing takes would come on top each time.
            due_us = max(due_us, now_us - DRAW_US) + DRAW_US
            # Nobody watches: nothing is drawn.
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
    """Be a view until the input ends."""
    outgoing = os.fdopen(os.dup(1), "wb", buffering=0)
    # What libraries print must not reach the harness as an answer.
    os.dup2(2, 1)
    request = Request.model_validate_json(sys.stdin.buffer.readline())
    give_way(NICENESS)
    warnings.simplefilter("ignore", DeprecationWarning)
    server = LocalServer(request.port or 0)
    port = server.get_port()
    if request.port not in (None, port):
        outgoing.write(Answer().model_dump_json().encode() + b"\n")
        return 0
    ends = Ends()
    outgoing.write(Answer(port=port, ends=ends.ends).model_dump_json().encode() + b"\n")
    ended = threading.Event()

    def listen() -> None:
        while os.read(0, 4096):
            pass
        ended.set()

    threading.Thread(target=listen, name="harness", daemon=True).start()
    View(server, ends, request).run(ended)
    server.stop()
    ends.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
