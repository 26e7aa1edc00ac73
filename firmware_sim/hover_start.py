"""Hover start: an episode that begins in the air, above the start.

The built-in autopilot flies a take-off before the episode begins: without MAVLink, camera and
recording, as fast as plant and autopilot are computed. The states of estimator, commander, battery
and wind result from this take-off.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from airl_mav.core.constants import (
    TAKEOFF_REACHED_M,
    TAKEOFF_REACHED_M_S,
    US_PER_S,
)
from airl_mav.core.frames import Geodetic
from firmware_sim.autopilot.autopilot_state import Mode, Result
from firmware_sim.autopilot.commander import FlightPhase

if TYPE_CHECKING:
    from firmware_sim.autopilot.autopilot import BuiltinAutopilot
    from firmware_sim.simulation import Simulation

GROUND_LIMIT_S = 30.0
"""Maximum time for boot, arming, spin-up and the approach of the altitude [s]."""

CLIMB_LIMIT_M_S = 0.5
"""Minimum mean climb speed [m/s]; PX4 takes off at 1.5 m/s."""

LOOK_US = US_PER_S // 10
"""Interval of checks of the vehicle's state [µs]."""

ARM_RETRY_US = US_PER_S
"""Interval of arm requests while pre-arm checks fail [µs]."""

NEVER_US = 1 << 61
"""Start of the episode for its faults during the take-off [µs]: never."""


class HoverStart(NamedTuple):
    """Height and origin of a hover start."""

    altitude_m: float
    """Height above the start [m]."""
    origin: Geodetic | None = None
    """Geodetic start position for a vehicle without GPS; None = measured by GPS."""

    def fly(self, simulation: Simulation) -> bool:
        """Take off and hold at the altitude; call `Simulation.begin` afterwards.

        Moving obstacles are stationary and faults inactive until then. Requires the built-in
        autopilot, at rest on the ground.

        Returns:
            True if the altitude was reached. Otherwise the vehicle stays where the attempt ended,
            and clients receive the texts that explain the reason.
        """
        autopilot = simulation.autopilot.internals
        assert autopilot is not None  # noqa: S101 (`airl_mav.scenario.checks` refuses others)
        if self.origin is not None:
            autopilot.set_origin(self.origin)
        recorder, simulation.recorder = simulation.recorder, None
        on_message, autopilot.on_message = autopilot.on_message, None
        if simulation.faults is not None:
            simulation.faults.begin(NEVER_US)
        limit_s = GROUND_LIMIT_S + self.altitude_m / CLIMB_LIMIT_M_S
        reached = self._climb(simulation, autopilot, simulation.time_us + round(limit_s * US_PER_S))
        simulation.recorder, autopilot.on_message = recorder, on_message
        if reached:
            autopilot.take_messages()
            autopilot.take_events()
        return reached

    def _climb(self, simulation: Simulation, autopilot: BuiltinAutopilot, until_us: int) -> bool:
        """Arm and climb; return True if the altitude is reached before `until_us` [µs]."""
        start_m, arm_us = 0.0, simulation.time_us
        simulation.plant.hold_obstacles()
        while simulation.time_us < until_us:
            look_us = simulation.time_us + LOOK_US
            while simulation.time_us < look_us:
                simulation.advance(look_us)
            flight, estimate = autopilot.flight, autopilot.estimator.estimate()
            down_m, down_m_s = estimate.position.item(2), estimate.velocity.item(2)
            if flight.phase is FlightPhase.STANDBY and simulation.time_us >= arm_us:
                start_m, arm_us = down_m, simulation.time_us + ARM_RETRY_US
                if autopilot.arm(force=False) is Result.ACCEPTED:
                    autopilot.takeoff(self.altitude_m)
            elif flight.phase is FlightPhase.AIR and flight.mode is Mode.HOLD:
                height_m = start_m - down_m
                climbs = height_m < self.altitude_m - TAKEOFF_REACHED_M
                if not climbs and abs(down_m_s) < TAKEOFF_REACHED_M_S:
                    return True
        return False
