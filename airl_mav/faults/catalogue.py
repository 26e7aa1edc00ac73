"""Faults of the matrix, and the allowed results of a flight with each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from airl_mav.faults.kinds import Phase

End = Literal["not armed", "landed", "crashed", "flying", "flown away", "broken"]
"""Result of a flight.

not armed: arming was rejected; landed: on the ground, motors off, touchdown below the maximum
landing speed; crashed: faster, or upside down; flying: still in the air at the end; flown away:
further from home, or higher, than the bound; broken: NaN or infinity, or an exception.
"""

MATRIX_PHASES: tuple[Phase, ...] = (*("ground", "climb", "hold", "offboard", "mission", "landing"),)

SAFE: frozenset[End] = frozenset({"landed"})
FALLS: frozenset[End] = frozenset({"landed", "crashed"})
"""Results without control: the vehicle falls, within the bounds."""


@dataclass(frozen=True)
class Case:
    """Fault of the matrix."""

    fault: str
    """Fault specification as text, without a time."""
    ends: frozenset[End] = SAFE
    """Allowed results if the fault began in the air."""
    on_ground: frozenset[End] = frozenset({"not armed", "landed"})
    """Allowed results if the fault began on the ground."""

    def allowed(self, phase: Phase) -> frozenset[End]:
        """Return the allowed results for a phase."""
        return self.on_ground | self.ends if phase == "ground" else self.ends


CASES: tuple[Case, ...] = (
    Case("accel off", FALLS),
    Case("accel noise 10x"),
    Case("accel bias 0.5,0.5,0.5m/s2"),
    Case("gyro off", FALLS),
    Case("gyro noise 10x"),
    Case("gyro bias 2,2,2deg/s"),
    Case("gyro delay 8ms"),
    Case("mag off"),
    Case("mag stuck"),
    Case("mag bias 0.1,0.1,0gauss"),
    Case("baro off"),
    Case("baro stuck"),
    Case("baro noise 10x"),
    Case("baro bias 0.5hPa"),
    Case("gps off"),
    Case("gps off for 2s"),
    Case("gps stuck"),
    Case("gps noise 5x"),
    Case("gps bias 20,0,0m"),
    Case("gps drift 0.5,0,0m/s"),
    Case("gps delay 200ms"),
    Case("gps delay 1s", FALLS),
    Case("motor1 off", FALLS),
    Case("motor2 weak 75%"),
    Case("motor2 mismatch 20%"),
    Case("motor2 slow 4x"),
    Case("battery drop 60%"),
    Case("battery drop 92%"),
    Case("battery sag 0.3V"),
    Case("wind gust 6,0,0m/s for 4s"),
    Case("wind step 5,0,0m/s"),
)
"""Faults that PX4 is expected to survive, and faults that no quadrotor survives. Covers the flight
controller alone: camera and link faults belong to the companion."""

STANDS: frozenset[End] = frozenset({"landed", "flying"})
"""Results without a landing detection: safe, but the motors may keep running."""

FITTED_CASES: tuple[Case, ...] = (
    Case("rangefinder off"),
    Case("rangefinder stuck", STANDS, frozenset({"not armed", "landed", "flying"})),
    Case("rangefinder noise 5x"),
    Case("rangefinder bias 0.5m"),
    Case("flow off"),
    Case("flow stuck"),
    Case("flow noise 5x"),
)
"""Faults of optional sensors, flown only on request."""

CASE_OF: Mapping[str, Case] = {case.fault: case for case in (*CASES, *FITTED_CASES)}
