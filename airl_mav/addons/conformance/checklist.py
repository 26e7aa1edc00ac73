"""Transcript and checks of a run, and the expected reactions of each autopilot."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from enum import Enum, IntEnum
from functools import partial
from typing import Any, Literal, NamedTuple

from airl_mav.core.clock import Clock
from airl_mav.core.constants import US_PER_S
from companion.link_interface import LinkError


class MavCommand(IntEnum):
    """MAV_CMD."""

    NAV_LAND = 21
    NAV_TAKEOFF = 22
    DO_SET_MODE = 176
    COMPONENT_ARM_DISARM = 400
    SET_MESSAGE_INTERVAL = 511
    REQUEST_MESSAGE = 512


MavResult = IntEnum(
    "MavResult",
    "ACCEPTED TEMPORARILY_REJECTED DENIED UNSUPPORTED FAILED IN_PROGRESS CANCELLED",
    start=0,
)
LandedState = IntEnum("LandedState", "UNDEFINED ON_GROUND IN_AIR TAKEOFF LANDING", start=0)


class MavFrame(IntEnum):
    """MAV_FRAME values valid in SET_POSITION_TARGET_LOCAL_NED."""

    LOCAL_NED = 1
    LOCAL_OFFSET_NED = 7
    BODY_NED = 8
    BODY_OFFSET_NED = 9
    BODY_FRD = 12


UNKNOWN_COMMAND = 29_999  # Undefined in all dialects
ARMED_FLAG = 128  # MAV_MODE_FLAG_SAFETY_ARMED
CUSTOM_MODE_FLAG = 1  # MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
PREARM_CHECK = 0x1000_0000  # MAV_SYS_STATUS_PREARM_CHECK: the vehicle may be armed


def command_long(number: int, *params: float) -> dict[str, float]:
    """Return the fields of a COMMAND_LONG; missing parameters are 0."""
    padded = (*params, *[0.0] * 7)[:7]
    numbered = {f"param{index}": value for index, value in enumerate(padded, 1)}
    return {"command": int(number), "confirmation": 0, **numbered}


def name_of(kind: type[IntEnum], number: int) -> str:
    """Return the name of a number, or the number itself without a name."""
    try:
        return kind(number).name
    except ValueError:
        return str(number)


LineKind = Literal["sent", "heard", "check", "note"]


class TranscriptLine(NamedTuple):
    """One line of the transcript."""

    time_s: float
    """Time since the start, in the vehicle's seconds [s]."""
    kind: LineKind
    text: str


class Transcript:
    """Ordered log of all messages sent and received; written by any thread."""

    def __init__(self, clock: Clock, progress: Callable[[TranscriptLine], None]) -> None:
        """Start empty. `progress` is called with each line, by the thread that adds it."""
        self._clock, self._progress = clock, progress
        self._lock = threading.Lock()
        self.lines: list[TranscriptLine] = []
        self._repeated = 0

    @property
    def time_s(self) -> float:
        """Current time on the lines' scale [s]."""
        return self._clock.time_us() / US_PER_S

    def add(self, kind: LineKind, text: str) -> None:
        """Add a line; a repetition of the last line is only counted."""
        with self._lock:
            if self.lines and self.lines[-1][1:] == (kind, text):
                self._repeated += 1
                return
            if self._repeated:
                self._append("note", f"... and {self._repeated} times more")
                self._repeated = 0
            self._append(kind, text)

    def _append(self, kind: LineKind, text: str) -> None:
        line = TranscriptLine(self.time_s, kind, text)
        self.lines.append(line)
        self._progress(line)


class CheckOutcome(Enum):
    """Outcome of a check."""

    PASSED = "pass"
    FAILED = "fail"
    NOT_APPLICABLE = "not applicable"


class ConformanceCheck(NamedTuple):
    """Completed check."""

    name: str
    outcome: CheckOutcome
    finding: str
    time_s: float
    """Duration by the transcript's clock [s]."""


class CheckFailedError(Exception):
    """Failure of a check; the message is its finding."""


class NotApplicableError(Exception):
    """The check does not apply to this vehicle; the message is the reason."""


def require(condition: object, finding: str) -> str:
    """Return a finding, or raise CheckFailedError with it unless a condition is true."""
    if not condition:
        raise CheckFailedError(finding)
    return finding


class CheckDefinition(NamedTuple):
    """Definition of a check."""

    name: str
    function: Callable[[Any], str]
    """Runs the check on a Vehicle and returns its finding. Raises as in `Checklist.perform`."""
    essential: bool = False
    """True if its failure skips the rest of the table."""
    for_steps: bool = False
    """True if it also runs for step responses alone."""


class Checklist:
    """Checks in the order of execution."""

    def __init__(self, transcript: Transcript) -> None:
        self._transcript = transcript
        self.checks: list[ConformanceCheck] = []

    def perform(self, name: str, check: Callable[[], str]) -> bool:
        """Run a check and return True if it did not fail.

        `check` returns its finding, or raises CheckFailedError or NotApplicableError. LinkError and
        KeyboardInterrupt are recorded as failures and raised again.
        """
        start_s = self._transcript.time_s
        try:
            self._note(name, CheckOutcome.PASSED, check(), start_s)
        except NotApplicableError as reason:
            self._note(name, CheckOutcome.NOT_APPLICABLE, str(reason), start_s)
        except CheckFailedError as finding:
            self._note(name, CheckOutcome.FAILED, str(finding), start_s)
            return False
        except (LinkError, KeyboardInterrupt) as error:
            self._note(name, CheckOutcome.FAILED, str(error) or "interrupted", start_s)
            raise
        return True

    def perform_all(
        self, table: Iterable[CheckDefinition], vehicle: Any, *, steps_only: bool = False
    ) -> bool:
        """Make the checks of a table on a Vehicle; return True if no essential one failed."""
        return all(
            self.perform(entry.name, partial(entry.function, vehicle)) or not entry.essential
            for entry in table
            if entry.for_steps or not steps_only
        )

    def _note(self, name: str, outcome: CheckOutcome, finding: str, start_s: float) -> None:
        self.checks.append(
            ConformanceCheck(name, outcome, finding, self._transcript.time_s - start_s)
        )
        self._transcript.add("check", f"{name}: {outcome.value}: {finding}")


class Reaction(Enum):
    """Reaction of an autopilot to a setpoint."""

    FLOWN = "flown"
    REFUSED = "refused"
    """Rejected with a STATUSTEXT for every message; it does not count as a setpoint."""
    IGNORED = "ignored"
    """Ignored without a STATUSTEXT."""


class ExpectedAnswer(NamedTuple):
    """Expected answer to a command."""

    result: MavResult
    text: str = ""
    """Part of the STATUSTEXT sent with it; "": any or none."""


class ExpectedLoss(NamedTuple):
    """Expected reaction when setpoints stop and heartbeats continue."""

    starts_s: tuple[float, float]
    """Earliest and latest time of the reaction, from the last setpoint [s]."""
    text: str
    """Part of the STATUSTEXT that reports it; "": none, the reaction is detected by speed."""
    modes: tuple[int, ...]
    """Accepted values of HEARTBEAT.custom_mode during it."""
    down_m_s: tuple[float, float] | None
    """Minimum and maximum speed down after it [m/s]; None if it brakes and hovers."""


class Autopilot(NamedTuple):
    """Expected behaviour of one autopilot."""

    title: str
    offboard: tuple[int, int]
    """Parameters 2 and 3 of DO_SET_MODE for offboard (ArduPilot: GUIDED)."""
    hold: tuple[int, int]
    offboard_mode: int
    """HEARTBEAT.custom_mode in offboard."""
    hold_modes: tuple[int, ...]
    """custom_mode after MAVSDK's offboard.stop()."""
    land_mode: int
    after_takeoff_mode: int
    mode_names: Mapping[int, str]
    offboard_on_ground: ExpectedAnswer
    """Answer to an offboard request on the ground, without a setpoint."""
    arms_without_setpoint: bool
    """True if it can be armed in that state."""
    offboard_in_air: ExpectedAnswer
    disarm_in_air: ExpectedAnswer
    unknown_mode: ExpectedAnswer
    frames: Mapping[MavFrame, Reaction]
    ignore_all: Reaction
    """Reaction to a type mask that ignores everything."""
    loss: ExpectedLoss

    def mode_name(self, mode: int) -> str:
        """Return the name of a custom_mode."""
        return self.mode_names.get(mode, f"mode {mode}")


def _px4_mode(main: int, sub: int = 0) -> int:
    return main << 16 | sub << 24


_PX4_HOLD, _PX4_OFFBOARD, _PX4_POSITION = _px4_mode(4, 3), _px4_mode(6), _px4_mode(3)
_PX4_RETURN = _px4_mode(4, 5)

PX4 = Autopilot(
    title="PX4",
    offboard=(6, 0),
    hold=(4, 3),
    offboard_mode=_PX4_OFFBOARD,
    hold_modes=(_PX4_HOLD,),
    land_mode=_px4_mode(4, 6),
    after_takeoff_mode=_PX4_HOLD,
    mode_names={_px4_mode(1): "MANUAL", _px4_mode(2): "ALTCTL", _PX4_POSITION: "POSCTL"}
    | {_px4_mode(4, 2): "TAKEOFF", _PX4_HOLD: "HOLD", _px4_mode(4, 4): "MISSION"}
    | {_PX4_RETURN: "RTL", _px4_mode(4, 6): "LAND"}
    | {_PX4_OFFBOARD: "OFFBOARD", _px4_mode(7): "STABILIZED"},
    offboard_on_ground=ExpectedAnswer(MavResult.ACCEPTED),
    arms_without_setpoint=False,
    offboard_in_air=ExpectedAnswer(
        MavResult.TEMPORARILY_REJECTED, "Switching to Offboard is currently not available"
    ),
    disarm_in_air=ExpectedAnswer(MavResult.TEMPORARILY_REJECTED, "Disarming denied"),
    unknown_mode=ExpectedAnswer(MavResult.ACCEPTED),
    frames=dict.fromkeys(MavFrame, Reaction.REFUSED)
    | dict.fromkeys((MavFrame.LOCAL_NED, MavFrame.BODY_NED), Reaction.FLOWN),
    ignore_all=Reaction.REFUSED,
    # COM_OF_LOSS_T = 1 s; 1.06 to 1.13 s measured. MPC_LAND_SPEED = 0.7 m/s.
    loss=ExpectedLoss((1.0, 1.5), "Failsafe activated", (_PX4_POSITION,), (0.3, 1.2)),
)
# Return climbs with MPC_Z_V_AUTO_UP = 3 m/s. PX4 1.17 has it since its last beta.
_RETURN = PX4.loss._replace(modes=(_PX4_RETURN,), down_m_s=(-3.5, 0.5))
_EITHER = PX4.loss._replace(modes=(_PX4_POSITION, _PX4_RETURN), down_m_s=(-3.5, 1.2))
_REJECTED = ExpectedAnswer(MavResult.TEMPORARILY_REJECTED)
RELEASES: Mapping[str, Autopilot] = {
    "px4-1.17": PX4._replace(loss=_EITHER),
    "px4-1.18": PX4._replace(loss=_RETURN, unknown_mode=_REJECTED),
}
"""Behaviour of releases that differs, by the name of their column."""

_GUIDED, _BRAKE, _LOITER = 4, 17, 5

ARDUPILOT = Autopilot(
    title="ArduPilot",
    offboard=(_GUIDED, 0),
    hold=(_BRAKE, 0),
    offboard_mode=_GUIDED,
    hold_modes=(_BRAKE, _LOITER),
    land_mode=9,
    after_takeoff_mode=_GUIDED,
    mode_names={0: "STABILIZE", 2: "ALT_HOLD", 3: "AUTO", _GUIDED: "GUIDED", _LOITER: "LOITER"}
    | {6: "RTL", 9: "LAND", 16: "POSHOLD", _BRAKE: "BRAKE"},
    offboard_on_ground=ExpectedAnswer(MavResult.ACCEPTED),
    arms_without_setpoint=True,
    offboard_in_air=ExpectedAnswer(MavResult.ACCEPTED),
    disarm_in_air=ExpectedAnswer(MavResult.FAILED),
    unknown_mode=ExpectedAnswer(MavResult.FAILED, "No such mode"),
    frames=dict.fromkeys(MavFrame, Reaction.FLOWN) | {MavFrame.BODY_FRD: Reaction.IGNORED},
    ignore_all=Reaction.IGNORED,
    # GUID_TIMEOUT = 3 s; it began to brake after 3.05 s.
    loss=ExpectedLoss((2.9, 3.6), "", (_GUIDED,), None),
)

AUTOPILOTS: Mapping[int, Autopilot] = {12: PX4, 3: ARDUPILOT}
