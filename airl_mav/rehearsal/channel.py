"""The control channel between the harness and a process it supervises: JSON lines over pipes.

Requests go to the child's standard input, events come from its standard output. What the child
wants to say to people goes to standard error. The end of standard input means that the harness is
gone: the child ends. Because it is only pipes, the same channel runs through `ssh`.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from typing import Annotated, Any, BinaryIO, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from airl_mav.core.errors import EXIT_BROKEN, EXIT_USAGE, UsageError
from airl_mav.core.fields import field_error
from airl_mav.core.goals import Goal
from airl_mav.core.process_use import ProcessUse
from airl_mav.scenario.resolved import ResolvedScenario
from airl_mav.view.ends import ViewEnds


class _Line(BaseModel):
    """One message."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    def to_line(self) -> bytes:
        """Return the wire form."""
        return self.model_dump_json().encode() + b"\n"


# --- rehearsal -> both


class Begin(_Line):
    """What the process is to be: its first line."""

    type: Literal["begin"] = "begin"
    scenario: ResolvedScenario
    log: str | None = None
    """File for the output of real firmware."""
    view: ViewEnds | None = None
    """Where the flights are watched; None: nowhere."""


# --- rehearsal -> firmware


class LoadEpisode(_Line):
    """Set up a new arena with the vehicle at rest in it; the autopilot boots."""

    type: Literal["load"] = "load"
    episode: int
    seed: int
    """Of arena, sensors and wind."""
    tlog: str | None
    """Write the MAVLink log here."""
    record: str
    """Write the flight's arrays (.npz) here when the episode is finished."""


class FinishEpisode(_Line):
    """Stop the episode and save its arrays."""

    type: Literal["finish"] = "finish"


# --- rehearsal -> companion


class Fly(_Line):
    """Fly one mission."""

    type: Literal["fly"] = "fly"
    episode: int
    goal: Goal
    """North, east [m] from the start."""
    epoch_ns: int | None
    """Host monotonic time of simulated time 0 when both share a host; None = start a clock."""
    seed: int
    """Of the injected latency, and of random actions."""
    record: str
    """Write the decision log (.npz) here."""


class Abort(_Line):
    """End the mission now."""

    type: Literal["abort"] = "abort"
    land: bool
    """Stop and land; False after a crash: there is nothing left to land."""


class Shutdown(_Line):
    """End the process."""

    type: Literal["shutdown"] = "shutdown"


# --- events


class Compiling(_Line):
    """The process begins to compile kernels, or ends it: at the first start after an install."""

    type: Literal["compiling"] = "compiling"
    begins: bool


class Ready(_Line):
    """The process can take requests."""

    type: Literal["ready"] = "ready"


class Loaded(_Line):
    """The episode stands: the vehicle waits at the start."""

    type: Literal["loaded"] = "loaded"
    episode: int
    time_us: int
    epoch_ns: int | None
    """Host monotonic time of simulated time 0; None when time is not paced."""
    slipped_us: int
    """Simulated time given up before, because the host could not keep up."""
    goal: Goal


class State(_Line):
    """The true state, a few times a second."""

    type: Literal["state"] = "state"
    time_us: int
    position: tuple[float, float, float]
    speed_m_s: float
    yaw: float
    battery: float
    collision: str | None
    mode: str
    armed: bool
    landed: bool
    slipped_us: int
    """Simulated time given up since the start because the host could not keep up."""


class Text(_Line):
    """A STATUSTEXT of the autopilot."""

    type: Literal["text"] = "text"
    time_us: int
    severity: int
    text: str


class LogLost(_Line):
    """A log of the flight cannot be written any more; the flight goes on."""

    type: Literal["log_lost"] = "log_lost"
    what: str
    """Which file, and why."""


class Due(_Line):
    """A process's fault begins or ends; a firmware to be killed has saved its arrays."""

    type: Literal["due"] = "due"
    time_us: int
    fault: str
    """In words (docs/how-to/faults.md)."""
    begins: bool


class Saved(_Line):
    """The episode's arrays are on disk."""

    type: Literal["saved"] = "saved"
    path: str
    """Of the arrays."""
    sha256: dict[str, str] = Field(default_factory=dict)
    """In lockstep, the fingerprint of the flight by lane; see docs/explanation/lockstep.md."""


class Progress(_Line):
    """The mission has entered a phase."""

    type: Literal["progress"] = "progress"
    phase: str
    time_us: int


class Ended(_Line):
    """The mission is over."""

    type: Literal["ended"] = "ended"
    reason: str
    notes: tuple[str, ...] = ()
    path: str
    """Of the decision log."""
    by_hand: bool = False
    """Whether its latency or its compensation was changed by hand."""
    use: ProcessUse | None = None
    """What the mission took of the companion's machine; None where it is no process of its own."""
    sha256: dict[str, str] = Field(default_factory=dict)
    """In lockstep, the fingerprint of what the policy saw; see docs/explanation/lockstep.md."""


class Failed(_Line):
    """The process cannot go on and will end."""

    type: Literal["failed"] = "failed"
    message: str
    usage: bool = False
    """The input cannot be used: to start again would not help."""


Request = Annotated[
    Begin | LoadEpisode | FinishEpisode | Fly | Abort | Shutdown, Field(discriminator="type")
]
Event = Annotated[
    Compiling | Ready | Loaded | State | Text | LogLost | Due | Saved | Progress | Ended | Failed,
    Field(discriminator="type"),
]
_REQUESTS: TypeAdapter[Any] = TypeAdapter(Request)
_EVENTS: TypeAdapter[Any] = TypeAdapter(Event)


def parse_event(line: bytes) -> Event:
    """Read one event line. Raises ValueError (pydantic's) for anything else."""
    event: Event = _EVENTS.validate_json(line)
    return event


class ChildChannel:
    """The child's end: requests in through a callback, events out."""

    def __init__(self, incoming: BinaryIO, outgoing: BinaryIO) -> None:
        self._incoming = incoming
        self._outgoing = outgoing
        self._lock = threading.Lock()

    @classmethod
    def on_stdio(cls) -> ChildChannel:
        """Take over standard input and output, so that no library's output garbles the channel."""
        outgoing = os.fdopen(os.dup(1), "wb", buffering=0)
        os.dup2(2, 1)
        # Unbuffered: the reading thread must hold no lock that the end of the interpreter wants.
        return cls(os.fdopen(os.dup(0), "rb", buffering=0), outgoing)

    def send(self, event: _Line) -> None:
        """Send one event; a harness that is gone is no error here (its end of file is)."""
        try:
            with self._lock:
                self._outgoing.write(event.to_line())
        except BrokenPipeError:
            return

    def begin(self) -> Begin | None:
        """Wait for the first line, or None when the rehearsal is gone before it."""
        line = self._incoming.readline()
        if not line:
            return None
        try:
            return Begin.model_validate_json(line)
        except ValidationError as error:
            raise UsageError(f"not a scenario: {field_error(error)}: {line[:200]!r}") from None

    def listen(self, handle: Callable[[Any], None], gone: Callable[[], None]) -> None:
        """Call `handle` for every request, on a thread; `gone` when the harness is gone.

        `gone` is also called when `handle` fails: then nobody would hear the end of the harness.
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
    """Be a child process: take its first line, work, and say why it failed; return its status."""
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
    return 0
