"""The faults of the matrix, and how a flight may end with each of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from airl_mav.faults.kinds import Phase

End = Literal["not armed", "landed", "crashed", "flying", "flown away", "broken"]
"""How a flight can end.

not armed: it was refused; landed: on the ground, motors off, touched down slower than a landing may
be; crashed: faster, or upside down; flying: still in the air at the end of the time; flown away:
further from home, or higher, than the bound; broken: a number that is none, or an exception.
"""

MATRIX_PHASES: tuple[Phase, ...] = (*("ground", "climb", "hold", "offboard", "mission", "landing"),)

SAFE: frozenset[End] = frozenset({"landed"})
FALLS: frozenset[End] = frozenset({"landed", "crashed"})
"""Nothing is left to fly with: it comes down, and stays within the bounds."""


@dataclass(frozen=True)
class Case:
    """One fault of the matrix."""

    fault: str
    """In words, without a time."""
    ends: frozenset[End] = SAFE
    """How a flight may end that was in the air when it happened."""
    on_ground: frozenset[End] = frozenset({"not armed", "landed"})
    """How a flight may end that was on the ground."""

    def allowed(self, phase: Phase) -> frozenset[End]:
        """Return how a flight may end."""
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
"""What PX4 is expected to survive, and what no quadrotor does. Of the flight controller alone: the
camera, and the link beyond what it carries, are the companion's."""

STANDS: frozenset[End] = frozenset({"landed", "flying"})
"""It comes down safely, and may not be told that it stands: its motors go on."""

FITTED_CASES: tuple[Case, ...] = (
    Case("rangefinder off"),
    Case("rangefinder stuck", STANDS, frozenset({"not armed", "landed", "flying"})),
    Case("rangefinder noise 5x"),
    Case("rangefinder bias 0.5m"),
    Case("flow off"),
    Case("flow stuck"),
    Case("flow noise 5x"),
)
"""Of sensors that not every vehicle has: in no matrix but one that asks for them."""

CASE_OF: Mapping[str, Case] = {case.fault: case for case in (*CASES, *FITTED_CASES)}
