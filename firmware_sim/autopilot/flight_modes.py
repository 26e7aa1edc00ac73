"""Table of the flight modes: `Mode`, each member with its properties (`Mode.HOLD.spec`).

To add a mode, add a member here, and its implementation as a file in `modes/`. Source of the
numbers: PX4 1.16, px4_custom_mode.h, VehicleStatus.msg and commander/ModeUtil.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag, auto, unique

from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.events.definition import Definition, NavigationMode


class Need(IntFlag):
    """Requirements of flight modes."""

    ANGULAR_VELOCITY = auto()
    ATTITUDE = auto()
    ALTITUDE = auto()
    LOCAL_POSITION = auto()
    LOCAL_POSITION_RELAXED = auto()
    GLOBAL_POSITION = auto()
    HOME = auto()
    MISSION = auto()
    OFFBOARD_SIGNAL = auto()
    MANUAL_CONTROL = auto()
    """Pilot input. Its loss does not end a mode: a separate failsafe handles it."""
    CALM_AND_TIME = auto()
    """Wind and flight time within limits; separate failsafes handle violations."""
    NOT_ARMING = auto()
    """Arming is not possible in this mode."""


_LEVEL = Need.ANGULAR_VELOCITY | Need.ATTITUDE
_PILOTED = _LEVEL | Need.LOCAL_POSITION_RELAXED | Need.ALTITUDE
_GUIDED = _LEVEL | Need.LOCAL_POSITION | Need.ALTITUDE
_GLOBAL = _GUIDED | Need.GLOBAL_POSITION

MAIN_POSCTL, MAIN_AUTO = 3, 4

StandardMode = IntEnum(
    "StandardMode",
    "NON_STANDARD POSITION_HOLD ORBIT CRUISE ALTITUDE_HOLD SAFE_RECOVERY MISSION LAND TAKEOFF",
    start=0,
)
"""Standard modes, numbered as in MAV_STANDARD_MODE."""


@dataclass(frozen=True, slots=True)
class ModeSpec:
    """Properties of a flight mode."""

    number: int
    """Value of the `Mode`."""
    title: str
    """Name in PX4's texts."""
    main: int
    """Main mode of custom_mode."""
    sub: int
    """Sub mode of custom_mode."""
    state: int
    """Navigation state (VehicleStatus.nav_state); AVAILABLE_MODES is in its order."""
    event: NavigationMode
    """Number in events."""
    needs: Need
    """Requirements. Modes with `Need.MANUAL_CONTROL` are flown by sticks."""
    lasting: bool = True
    """True if the mode remains selected after disarming; False = the last lasting mode returns."""
    requestable: bool = True
    """True if clients may request the mode; False = only commands and failsafes select it."""
    stabilized: bool = True
    """True if HEARTBEAT reports MAV_MODE_FLAG_STABILIZE_ENABLED."""
    standard: StandardMode = StandardMode.NON_STANDARD
    """Standard mode in AVAILABLE_MODES."""
    advanced: bool = True
    """True if AVAILABLE_MODES reports MAV_MODE_PROPERTY_ADVANCED."""
    variants: int = 0
    """Bits of further navigation states: variants in PX4 that are not flown here."""
    phase: str | None = None
    """Flight phase in the air, by the name used in faults; None = no fault starts in it."""
    command_event: Definition | None = None
    """Event of the mode's own MAVLink command; None = DO_SET_MODE only, which has no text."""
    command_text: str | None = None
    """Text of that command; None = the event's message."""

    @property
    def custom_mode(self) -> int:
        """PX4's custom_mode: main mode << 16 | sub mode << 24."""
        return self.main << 16 | self.sub << 24

    @property
    def state_bits(self) -> int:
        """Navigation states as bits, as in the mode masks of checks."""
        return 1 << self.state | self.variants


@unique
class Mode(IntEnum):
    """Flight modes."""

    spec: ModeSpec

    def __new__(cls, spec: ModeSpec) -> Mode:
        """Return a member with the number and the properties of a mode."""
        mode = int.__new__(cls, spec.number)
        mode._value_, mode.spec = spec.number, spec
        return mode

    # Number, title, main mode, sub mode, navigation state, number in events; requirements.
    HOLD = ModeSpec(
        *(0, "Hold", MAIN_AUTO, 3, 4, NavigationMode.AUTO_LOITER),
        _GLOBAL | Need.CALM_AND_TIME,
        phase="hold",
    )
    TAKEOFF = ModeSpec(
        *(1, "Takeoff", MAIN_AUTO, 2, 17, NavigationMode.AUTO_TAKEOFF),
        _GUIDED,
        lasting=False,
        standard=StandardMode.TAKEOFF,
        variants=1 << 22,  # VTOL take-off
        phase="climb",
    )
    LAND = ModeSpec(
        *(3, "Land", MAIN_AUTO, 6, 18, NavigationMode.AUTO_LAND),
        _PILOTED | Need.NOT_ARMING,
        lasting=False,
        standard=StandardMode.LAND,
        phase="landing",
        command_event=events.LANDING_HERE,
    )
    RETURN = ModeSpec(
        *(4, "Return", MAIN_AUTO, 5, 5, NavigationMode.AUTO_RTL),
        _GLOBAL | Need.HOME | Need.NOT_ARMING,
        lasting=False,
        standard=StandardMode.SAFE_RECOVERY,
        phase="return",
        command_event=events.RETURNING,
    )
    OFFBOARD = ModeSpec(
        *(2, "Offboard", 6, 0, 14, NavigationMode.OFFBOARD),
        _LEVEL | Need.OFFBOARD_SIGNAL,
        phase="offboard",
    )
    POSITION = ModeSpec(
        *(5, "Position", MAIN_POSCTL, 0, 2, NavigationMode.POSCTL),
        _PILOTED | Need.MANUAL_CONTROL,
        standard=StandardMode.POSITION_HOLD,
        advanced=False,
        variants=1 << 6,  # Position Slow
    )
    """Requires pilot input, like all stick modes. Without input, PX4 brakes and descends to the
    ground (measured): the offboard-loss fallback."""
    MISSION = ModeSpec(
        *(6, "Mission", MAIN_AUTO, 4, 3, NavigationMode.AUTO_MISSION),
        _GLOBAL | Need.MISSION | Need.CALM_AND_TIME,
        standard=StandardMode.MISSION,
        phase="mission",
    )
    ORBIT = ModeSpec(
        *(11, "Orbit", MAIN_POSCTL, 1, 21, NavigationMode.ORBIT),
        _GUIDED | Need.NOT_ARMING | Need.CALM_AND_TIME,
        lasting=False,
        standard=StandardMode.ORBIT,
    )
    FOLLOW = ModeSpec(
        *(12, "Follow Target", MAIN_AUTO, 8, 19, NavigationMode.AUTO_FOLLOW_TARGET),
        _GUIDED | Need.NOT_ARMING | Need.CALM_AND_TIME,
        lasting=False,
    )
    MANUAL = ModeSpec(7, "Manual", 1, 0, 0, NavigationMode.MANUAL, Need.MANUAL_CONTROL)
    """Same as Stabilized for a multicopter."""
    ALTITUDE = ModeSpec(
        *(10, "Altitude", 2, 0, 1, NavigationMode.ALTCTL),
        _LEVEL | Need.ALTITUDE | Need.MANUAL_CONTROL,
        standard=StandardMode.ALTITUDE_HOLD,
        advanced=False,
    )
    ACRO = ModeSpec(
        *(9, "Acro", 5, 0, 10, NavigationMode.ACRO),
        Need.ANGULAR_VELOCITY | Need.MANUAL_CONTROL,
        stabilized=False,
    )
    STABILIZED = ModeSpec(
        8, "Stabilized", 7, 0, 15, NavigationMode.STAB, _LEVEL | Need.MANUAL_CONTROL
    )
    DESCEND = ModeSpec(
        *(13, "Descend", MAIN_AUTO, 6, 12, NavigationMode.UNKNOWN),
        _LEVEL | Need.NOT_ARMING,
        lasting=False,
        requestable=False,
        standard=StandardMode.LAND,
    )
    """Level descent without a position estimate. PX4 reports it as Land."""
    TERMINATION = ModeSpec(
        *(14, "Termination", 10, 0, 13, NavigationMode.UNKNOWN), Need.NOT_ARMING, requestable=False
    )
    """The motors are stopped permanently."""
    PRECISION_LAND = ModeSpec(
        *(15, "Precision Landing", MAIN_AUTO, 9, 20, NavigationMode.AUTO_PRECLAND),
        _GUIDED | Need.NOT_ARMING,
        lasting=False,
        phase="landing",
        command_event=events.LANDING_PRECISELY,
        command_text="Precision landing",
    )
    """Landing on a reported landing target."""


WITH_STICKS = frozenset(mode for mode in Mode if Need.MANUAL_CONTROL in mode.spec.needs)
"""Modes that require pilot input."""

BY_CUSTOM_MODE = {mode.spec.custom_mode: mode for mode in reversed(Mode)}
"""First mode of each custom_mode: Land where PX4 does not distinguish Land and Descend."""
