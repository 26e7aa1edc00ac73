"""Process of a run's view, started and stopped with the run."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from pydantic import ValidationError

from airl_mav.core.child_process import ChildProcess
from airl_mav.core.clock import WallClock
from airl_mav.core.constants import LOOPBACK, US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.scenario.resolve import ResolvedScenario
from airl_mav.view.ends import ViewAnswer, ViewEnds, ViewSettings
from airl_mav.view.feed import Asked
from airl_mav.view.view_messages import Steering

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
        ends: ViewEnds,
        speed: float | None,
        new_clock: Callable[[float], WallClock] = WallClock,
    ) -> None:
        """Connect to a view; `speed` applies until the view sets another, None = unlimited."""
        self._asked = Asked(ends, Steering(speed=speed))
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
        asked = self._heard(self._asked.newest())
        while asked.paused and not self._left and not self._released:
            self._clock = None
            asked = self._heard(self._asked.newest(LOOK_S))
        if asked.speed is None:
            self._clock = None
            return
        clock = self._clock
        if (
            clock is None
            or clock.speed != asked.speed
            or clock.time_us() - time_us > BEHIND_S * US_PER_S * clock.speed
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
        self._asked.close()

    def _heard(self, asked: Steering) -> Steering:
        if self._steps is None or asked.steps < self._steps or not asked.paused:
            # The first request, the count of another view, or no pause: no step is pending.
            self._left = 0
        else:
            self._left += asked.steps - self._steps
        self._steps = asked.steps
        return asked


MODULE = "airl_mav.view.view_server"


class ViewError(Exception):
    """Error for a view that failed to start; the message contains the cause."""


def request_of(scenario: ResolvedScenario, name: str, port: int | None = None) -> ViewSettings:
    """Return the settings of a view of a scenario's flights; arguments as in `ViewSettings`."""
    paced = scenario.scenario.level == "lockstep"
    return ViewSettings(
        run=name,
        port=port,
        paced=paced,
        speed=(scenario.speed or REAL_TIME) if paced else None,
        steerable=True,
        compensable=scenario.vehicle.compensable,
        compensated=scenario.pilot.compensate,
    )


class Viewer:
    """Page that shows flights until closed."""

    def __init__(self, request: ViewSettings) -> None:
        """Start the viewer and wait for it; raise FieldError if the port is in use."""
        self._folder = tempfile.TemporaryDirectory(prefix="airl-view-")
        self._child = ChildProcess(
            [sys.executable, "-m", MODULE],
            Path(self._folder.name) / "view.log",
            capture_stdout=True,
        )
        try:
            answer = self._answer(request)
            if answer.ends is None:
                raise FieldError(
                    "view_port", request.port, problem="the port is taken; accepted: a free one"
                )
        except BaseException:
            self.close()
            raise
        self.ends: ViewEnds = answer.ends
        """Addresses for flights to connect to."""
        self.url = f"http://{LOOPBACK}:{answer.port}"
        """URL of the page for a browser."""

    def _answer(self, request: ViewSettings) -> ViewAnswer:
        stdin, stdout = self._child.stdin, self._child.stdout
        line = b""
        if stdin is not None and stdout is not None:
            with suppress(BrokenPipeError):
                stdin.write(request.model_dump_json().encode() + b"\n")
                stdin.flush()
                line = stdout.readline()
        try:
            return ViewAnswer.model_validate_json(line)
        except ValidationError:
            self._child.stop()
            raise ViewError(f"the view did not start\n{self._child.log_tail()}") from None

    def close(self) -> None:
        """Stop the process; open pages report a lost connection. Safe to call again."""
        self._child.stop()
        if self._child.stdout is not None:
            self._child.stdout.close()
        self._folder.cleanup()
