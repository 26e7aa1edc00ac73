"""Process of a run's view, and its non-blocking ZeroMQ link: a slow view loses messages."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import ExitStack, suppress
from typing import Any

import zmq
from pydantic import ValidationError

from airl_mav.addons.view import view_messages
from airl_mav.core import child_process, constants, errors, files
from airl_mav.core.clock import Clock, WallClock
from airl_mav.rehearsal.live_view import ViewAddresses, ViewError
from airl_mav.scenario.resolve import ResolvedScenario

REAL_TIME = 1.0
"""Default speed of a lockstep flight in a view, in simulated seconds per wall second."""

LOOK_S = 0.1
"""Poll timeout for viewers' requests while paused [wall s]."""

BEHIND_S = 0.2
"""Maximum delay that a flight catches up; a longer delay is skipped [wall s]."""


class Pace:
    """Limiter of a flight's speed. Call from one thread at a time."""

    def __init__(
        self,
        ends: ViewAddresses,
        speed: float | None,
        new_clock: Callable[[float], WallClock] = WallClock,
    ) -> None:
        """Connect to a view; `speed` applies until the view sets another, None = unlimited."""
        self._steering = Asked(ends, view_messages.Steering(speed=speed))
        self._new_clock = new_clock
        self._clock: WallClock | None = None
        self._steps: int | None = None
        self._left = 0
        """Single steps requested but not yet executed."""
        self._released = False

    def tick(self, time_us: int) -> None:
        """Block until the flight may continue from simulated `time_us` [µs]."""
        if self._released:
            return
        asked = self._heard(self._steering.newest())
        while asked.paused and not self._left and not self._released:
            self._clock = None
            asked = self._heard(self._steering.newest(LOOK_S))
        if asked.speed is None:
            self._clock = None
            return
        clock = self._clock
        if (
            clock is None
            or clock.speed != asked.speed
            or clock.time_us() - time_us > BEHIND_S * constants.US_PER_S * clock.speed
        ):
            self._clock = clock = self._new_clock(asked.speed)
            clock.epoch_ns -= int(time_us * 1_000 / asked.speed)
        clock.sleep_until(time_us)

    def decided(self) -> None:
        """End a single step: a decision was sent."""
        self._left = max(0, self._left - 1)

    def let_go(self) -> None:
        """Stop limiting the flight; thread-safe."""
        self._released = True

    def close(self) -> None:
        """Disconnect."""
        self._steering.close()

    def _heard(self, asked: view_messages.Steering) -> view_messages.Steering:
        if self._steps is None or asked.steps < self._steps or not asked.paused:
            # The first request, the count of another view, or no pause: no step is pending.
            self._left = 0
        else:
            self._left += asked.steps - self._steps
        self._steps = asked.steps
        return asked


MODULE = "airl_mav.addons.view.view_server"


def request_of(
    scenario: ResolvedScenario, name: str, port: int | None = None
) -> view_messages.ViewSettings:
    """Return the settings of a view of a scenario's flights; arguments as in `ViewSettings`."""
    paced = scenario.scenario.level == "lockstep"
    return view_messages.ViewSettings(
        run=name,
        port=port,
        paced=paced,
        speed=(scenario.speed or REAL_TIME) if paced else None,
        compensable=scenario.vehicle.compensable,
        compensated=scenario.pilot.compensate,
    )


class Viewer:
    """Page that shows flights until closed."""

    def __init__(self, request: view_messages.ViewSettings) -> None:
        """Start the viewer and wait for it; raise FieldError if the port is in use."""
        self._scratch = ExitStack()
        folder = self._scratch.enter_context(files.scratch_folder("airl-view-"))
        self._child = child_process.ChildProcess(
            [sys.executable, "-m", MODULE],
            folder / "view.log",
            capture_stdout=True,
        )
        try:
            answer = self._answer(request)
            if answer.ends is None:
                raise errors.FieldError(
                    "view_port", request.port, problem="the port is taken; accepted: a free one"
                )
        except BaseException:
            self.close()
            raise
        self.ends: ViewAddresses = answer.ends
        """Addresses for flights to connect to."""
        self.url = f"http://{constants.LOOPBACK}:{answer.port}"
        """URL of the page for a browser."""

    def _answer(self, request: view_messages.ViewSettings) -> view_messages.ViewAnswer:
        stdin, stdout = self._child.stdin, self._child.stdout
        line = b""
        if stdin is not None and stdout is not None:
            with suppress(BrokenPipeError):
                stdin.write(request.model_dump_json().encode() + b"\n")
                stdin.flush()
                line = stdout.readline()
        try:
            return view_messages.ViewAnswer.model_validate_json(line)
        except ValidationError:
            self._child.stop()
            raise ViewError(f"the view did not start\n{self._child.log_tail()}") from None

    def close(self) -> None:
        """Stop the process; open pages report a lost connection. Safe to call again."""
        self._child.stop()
        if self._child.stdout is not None:
            self._child.stdout.close()
        self._scratch.close()


QUEUED = 64
"""Queue limit on either side; messages beyond it are dropped."""

SILENCE_S = 5.0
"""Timeout after which a silent view counts as closed and its requests are dropped [s]."""


class Feed:
    """Sender of snapshots. Use from one thread at a time."""

    def __init__(self, ends: ViewAddresses) -> None:
        """Connect; the view may start later or be closed."""
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.PUSH)
        self._socket.setsockopt(zmq.SNDHWM, QUEUED)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.connect(ends.messages)

    def send(
        self, message: view_messages.ViewMessage, image: view_messages.Image | None = None
    ) -> None:
        """Send a message with its image, or drop it."""
        with suppress(zmq.Again):
            self._socket.send_multipart(view_messages.to_parts(message, image), zmq.NOBLOCK)

    def close(self) -> None:
        """Disconnect and drop queued messages."""
        self._socket.close(linger=0)
        self._context.term()


class Asked:
    """Receiver of the viewers' requests. Use from one thread at a time."""

    def __init__(
        self, ends: ViewAddresses, default: view_messages.Steering, clock: Clock | None = None
    ) -> None:
        """Connect to the view; `default` applies before its first message and after a timeout."""
        self._clock = clock or WallClock()
        self._heard_us = self._clock.time_us()
        self._default = self._newest = default
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.setsockopt(zmq.CONFLATE, 1)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.subscribe(b"")
        self._socket.connect(ends.steering)

    def newest(self, wait_s: float = 0.0) -> view_messages.Steering:
        """Return the newest requests, waiting up to `wait_s` [s] for a new message."""
        if self._socket.poll(round(1e3 * wait_s)):
            with suppress(ValidationError):
                self._newest = view_messages.Steering.model_validate_json(self._socket.recv())
            self._heard_us = self._clock.time_us()
        elif self._clock.time_us() - self._heard_us > SILENCE_S * constants.US_PER_S:
            self._newest = self._default
        return self._newest

    def close(self) -> None:
        """Disconnect."""
        self._socket.close(linger=0)
        self._context.term()


class Ends:
    """Sockets of the view: receive snapshots and publish viewers' requests."""

    def __init__(self) -> None:
        """Bind two free ports of the loopback address."""
        self._context = zmq.Context()
        self._inbox = self._bound(zmq.PULL)
        self._steering = self._bound(zmq.PUB)
        inbox, steering = _address(self._inbox), _address(self._steering)
        self.ends = ViewAddresses(messages=inbox, steering=steering)
        """Addresses for flights to connect to."""

    def _bound(self, kind: int) -> zmq.Socket[bytes]:
        socket: zmq.Socket[bytes] = self._context.socket(kind)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.RCVHWM if kind == zmq.PULL else zmq.SNDHWM, QUEUED)
        socket.bind(f"tcp://{constants.LOOPBACK}:*")
        return socket

    def take(self, wait_s: float) -> list[tuple[view_messages.Told, view_messages.Image | None]]:
        """Return all received messages, oldest first, waiting up to `wait_s` [s] for the first."""
        found: list[tuple[view_messages.Told, view_messages.Image | None]] = []
        wait_ms = round(1e3 * wait_s)
        while self._inbox.poll(wait_ms):
            read = view_messages.from_parts(self._inbox.recv_multipart())
            if read is not None:
                found.append(read)
            wait_ms = 0
            if len(found) >= 16 * QUEUED:
                break  # A flight at full speed: draw the received messages first.
        return found

    def ask(self, steering: view_messages.Steering) -> None:
        """Publish the requests; call repeatedly so that late subscribers receive them."""
        self._steering.send(steering.model_dump_json().encode(), zmq.NOBLOCK)

    def close(self) -> None:
        """Free the ports."""
        self._inbox.close(linger=0)
        self._steering.close(linger=0)
        self._context.term()


def _address(socket: zmq.Socket[Any]) -> str:
    return str(socket.getsockopt_string(zmq.LAST_ENDPOINT)).rstrip("\0")
