"""Control channel between the harness and a supervised process: JSON lines over pipes.

Requests go to the child's standard input, events come from its standard output. Messages for people
go to standard error. The child ends at the end of standard input, which means that the harness has
ended. The channel uses only pipes, so it also runs through `ssh`.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from typing import Annotated, Any, BinaryIO, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from airl_mav.core.errors import EXIT_BROKEN, EXIT_USAGE, UsageError, machine_failure
from airl_mav.core.fields import field_error
from airl_mav.core.frames import Goal
from airl_mav.core.resource_use import ProcessUse
from airl_mav.rehearsal.live_view import ViewAddresses
from airl_mav.scenario.resolve import ResolvedScenario


class _Line(BaseModel):
    """Message of the channel."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    def to_line(self) -> bytes:
        """Return the message as a line of JSON."""
        return self.model_dump_json().encode() + b"\n"


# --- rehearsal -> both


class Begin(_Line):
    """First line to a process: its configuration."""

    type: Literal["begin"] = "begin"
    scenario: ResolvedScenario
    log: str | None = None
    """File for the output of real firmware."""
    view: ViewAddresses | None = None
    """View that shows the flights; None: no view."""


# --- rehearsal -> firmware


class LoadEpisode(_Line):
    """Request to set up a new arena with the vehicle at rest; the autopilot boots."""

    type: Literal["load"] = "load"
    seed: int
    """Seed of arena, sensors and wind."""
    tlog: str | None
    """Path of the MAVLink log."""
    record: str
    """Path of the flight's arrays (.npz), written when the episode is finished."""


class FinishEpisode(_Line):
    """Request to stop the episode and save its arrays."""

    type: Literal["finish"] = "finish"


# --- rehearsal -> companion


class Fly(_Line):
    """Request to fly one mission."""

    type: Literal["fly"] = "fly"
    goal: Goal
    """Goal: north, east [m] from the start."""
    epoch_ns: int | None
    """Host monotonic time of simulated time 0 on a shared host; None = start a clock."""
    seed: int
    """Seed of the injected latency and of random actions."""
    record: str
    """Path of the decision log (.npz)."""


class Abort(_Line):
    """Request to end the mission now."""

    type: Literal["abort"] = "abort"
    land: bool
    """True to stop and land; False after a crash."""


class Shutdown(_Line):
    """Request to end the process."""

    type: Literal["shutdown"] = "shutdown"


# --- events


class Compiling(_Line):
    """Event: kernel compilation starts or ends, at the first start after an install."""

    type: Literal["compiling"] = "compiling"
    begins: bool


class Ready(_Line):
    """Event: the process accepts requests."""

    type: Literal["ready"] = "ready"


class Loaded(_Line):
    """Event: the episode is loaded, and the vehicle waits at the start."""

    type: Literal["loaded"] = "loaded"
    time_us: int
    epoch_ns: int | None
    """Host monotonic time of simulated time 0; None without pacing."""
    slipped_us: int
    """Simulated time skipped before the episode because the host could not keep up [µs]."""
    goal: Goal
    local_goal: Goal
    """Goal in the flight controller's local frame, where the companion flies."""
    poses: str
    """Source of the poses of a vehicle elsewhere; empty if it is simulated here."""
    firmware: str = ""
    """Name and version of real firmware; empty for the built-in autopilot."""


class State(_Line):
    """Event: the true state, several times a second."""

    type: Literal["state"] = "state"
    time_us: int
    position: tuple[float, float, float]
    speed_m_s: float
    battery: float
    collision: str | None
    armed: bool
    slipped_us: int
    """Simulated time skipped since the start because the host could not keep up [µs]."""


class Text(_Line):
    """Event: a STATUSTEXT of the autopilot."""

    type: Literal["text"] = "text"
    time_us: int
    severity: int
    text: str


class LogLost(_Line):
    """Event: a log of the flight cannot be written; the flight continues."""

    type: Literal["log_lost"] = "log_lost"
    what: str
    """File name and cause."""


class Due(_Line):
    """Event: a process fault starts or ends; before a kill, the firmware has saved its arrays."""

    type: Literal["due"] = "due"
    time_us: int
    fault: str
    """Fault specification as text (docs/how-to/faults.md)."""
    begins: bool


class Saved(_Line):
    """Event: the episode's arrays are on disk."""

    type: Literal["saved"] = "saved"


class PhaseEntered(_Line):
    """Event: the mission has entered a phase."""

    type: Literal["progress"] = "progress"
    phase: str
    time_us: int


class Ended(_Line):
    """Event: the mission is over."""

    type: Literal["ended"] = "ended"
    reason: str
    notes: tuple[str, ...] = ()
    by_hand: bool = False
    """True if the user changed latency or compensation during the flight."""
    use: ProcessUse | None = None
    """Resources used by the companion; None if it is not a separate process."""


class Failed(_Line):
    """Event: the process cannot continue and will end."""

    type: Literal["failed"] = "failed"
    message: str
    usage: bool = False
    """True for invalid input: a restart would not help."""
    errno: int | None = None
    """System error of the machine, such as a full disk; `message` is its file."""


Request = Annotated[
    Begin | LoadEpisode | FinishEpisode | Fly | Abort | Shutdown, Field(discriminator="type")
]
Event = Annotated[
    Compiling
    | Ready
    | Loaded
    | State
    | Text
    | LogLost
    | Due
    | Saved
    | PhaseEntered
    | Ended
    | Failed,
    Field(discriminator="type"),
]
_REQUESTS: TypeAdapter[Any] = TypeAdapter(Request)
_EVENTS: TypeAdapter[Any] = TypeAdapter(Event)


def parse_event(line: bytes) -> Event:
    """Read one event line. Raises pydantic's ValueError for an invalid line."""
    event: Event = _EVENTS.validate_json(line)
    return event


class ChildChannel:
    """The child's end of the channel: passes requests to a callback and sends events."""

    def __init__(self, incoming: BinaryIO, outgoing: BinaryIO) -> None:
        self._incoming = incoming
        self._outgoing = outgoing
        self._lock = threading.Lock()

    @classmethod
    def on_stdio(cls) -> ChildChannel:
        """Take over standard input and output, so that library output cannot enter the channel."""
        outgoing = os.fdopen(os.dup(1), "wb", buffering=0)
        os.dup2(2, 1)
        # Unbuffered: the reader thread must not hold a lock at interpreter shutdown.
        return cls(os.fdopen(os.dup(0), "rb", buffering=0), outgoing)

    def send(self, event: _Line) -> None:
        """Send one event; ignore a broken pipe, because the end of input reports it."""
        try:
            with self._lock:
                self._outgoing.write(event.to_line())
        except BrokenPipeError:
            return

    def begin(self) -> Begin | None:
        """Wait for the first line; return None if the harness ends before."""
        line = self._incoming.readline()
        if not line:
            return None
        try:
            return Begin.model_validate_json(line)
        except ValidationError as error:
            raise UsageError(f"not a scenario: {field_error(error)}: {line[:200]!r}") from None

    def listen(self, handle: Callable[[Any], None], gone: Callable[[], None]) -> None:
        """Call `handle` for every request, on a thread, and `gone` when the harness ends.

        Also calls `gone` when `handle` fails, because the thread then stops reading.
        """

        def loop() -> None:
            try:
                for line in self._incoming:
                    try:
                        request = _REQUESTS.validate_json(line)
                    except (ValidationError, UsageError):
                        sys.stderr.write(f"not a request: {line[:200]!r}\n")
                        continue
                    handle(request)
            finally:
                gone()

        threading.Thread(target=loop, name="channel", daemon=True).start()


def serve(work: Callable[[Begin, ChildChannel], None], lost: type[Exception]) -> int:
    """Run a child process: read its first line, work, report a failure; return the exit status."""
    channel = ChildChannel.on_stdio()
    # The rehearsal decides when to end, also on Ctrl-C: it closes the pipe.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        begin = channel.begin()
        if begin is None:
            return EXIT_BROKEN
        work(begin, channel)
    except (UsageError, lost) as error:
        usage = isinstance(error, UsageError)
        channel.send(Failed(message=str(error), usage=usage))
        return EXIT_USAGE if usage else EXIT_BROKEN
    except OSError as error:
        if machine_failure(error) is None:
            raise
        channel.send(Failed(message=str(error.filename or ""), errno=error.errno))
        return EXIT_BROKEN
    return 0
