"""ArduCopter's manners around the built-in autopilot: modes, refusals, motors. No sockets.

As measured on ArduCopter 4.7: see the comments. The flying itself is the built-in autopilot's.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.core.frames import (
    HOME,
    MAGNETIC_FIELD_NED,
    local_to_geodetic,
    quat_normalize,
    quat_to_matrix,
)
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.vehicle.atmosphere import pressure_hpa, temperature_c
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.autopilot_state import Landed, Result, Setpoint
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.parameter_store import Parameters
from firmware_sim.interfaces import BatterySample, GpsFix, SensorSample
from tests.support.ardupilot_wire import State

STABILIZE, GUIDED, LOITER, RTL, LAND, BRAKE = 0, 4, 5, 6, 9, 17
_BUILTIN = {LOITER: Mode.HOLD, RTL: Mode.RETURN, LAND: Mode.LAND, BRAKE: Mode.HOLD}
_POSITION_MODES = (GUIDED, LOITER, RTL, BRAKE)

GUID_TIMEOUT_US = 3 * US_PER_S
"""Hold time of a velocity without a new one; then the vehicle stops, still in GUIDED."""

SPIN_ARM = 0.05
"""Motors of an armed vehicle that stands."""

_GPS_US, _BARO_US = 200_000, 20_000
_BATTERY = BatterySample(16.0, 10.0, 0.0, 0.9)
_NAN3 = np.full(3, math.nan)
STOP = Setpoint(_NAN3, np.zeros(3), math.nan, 0.0)

PARAMETERS: dict[str, float] = {
    "AHRS_EKF_TYPE": 10,  # the default with no_time_sync
    "FRAME_CLASS": 1,
    "FRAME_TYPE": 0,  # PLUS, the default
    "GUID_TIMEOUT": 3.0,
    "MOT_BAT_VOLT_MAX": 0.0,
    "MOT_BAT_VOLT_MIN": 0.0,
    "MOT_PWM_MAX": 2000,
    "MOT_PWM_MIN": 1000,
    "MOT_SPIN_ARM": 0.1,
    "MOT_SPIN_MAX": 0.95,
    "MOT_SPIN_MIN": 0.15,
    "MOT_THST_EXPO": 0.65,
    "MOT_THST_HOVER": 0.35,
    "SCHED_LOOP_RATE": 400,
    "SERVO1_FUNCTION": 33,
    "SERVO2_FUNCTION": 34,
    "SERVO3_FUNCTION": 35,
    "SERVO4_FUNCTION": 36,
    "SIM_RATE_HZ": 1200,
}


class Copter:
    """Simulated sensors, the built-in autopilot at 250 Hz, and ArduCopter's modes."""

    def __init__(self, parameters: dict[str, float] | None = None, position_s: float = 3.0) -> None:
        """Power up.

        Args:
            parameters: Over ArduCopter's own.
            position_s: When the EKF begins to use GPS, at the earliest [s]; a real one takes 40.
        """
        self.parameters = {**PARAMETERS, **(parameters or {})}
        vehicle = load_profile("vehicles", "quad", VehicleProfile)
        self.inner = BuiltinAutopilot(Parameters(vehicle.parameters))
        self.mode = STABILIZE
        self.on_mode: Callable[[], None] = lambda: None
        self.say: Callable[[int, str], None] = lambda _severity, _text: None
        self.time_us = 0
        self._position_us = int(position_s * US_PER_S)
        self._position_ok = False
        self._armed = False
        self._tick_us = TICK_US
        self._imu: list[State] = []
        self._gps_us = self._baro_us = 0
        self._setpoint: Setpoint | None = None
        self._setpoint_us = 0

    # --- towards the simulator

    def step(self, state: State, time_us: int) -> list[int]:
        """Advance to a time [µs] and return the pulses of outputs 1 to 4 [µs]."""
        self.time_us = time_us
        self._imu.append(state)
        if time_us >= self._tick_us:
            self._guide()
            self.inner.step(self._sample(state))
            self._imu.clear()
            self._tick_us += TICK_US
            self._follow()
        return self._pulses()

    def _sample(self, state: State) -> SensorSample:
        at, north = np.array(state.position), np.array(state.velocity)
        attitude = quat_normalize(np.array(state.quaternion))
        gps = pressure = None
        if self._tick_us >= self._gps_us:
            self._gps_us += _GPS_US
            gps = GpsFix(local_to_geodetic(at, HOME), north, 0.3, 0.5, 10)
        if self._tick_us >= self._baro_us:
            self._baro_us += _BARO_US
            pressure = pressure_hpa(HOME.altitude_m - at[2])
        return SensorSample(
            self._tick_us,
            np.mean([s.accel for s in self._imu], axis=0),
            np.mean([s.gyro for s in self._imu], axis=0),
            temperature_c(HOME.altitude_m),
            _BATTERY,
            quat_to_matrix(attitude).T @ MAGNETIC_FIELD_NED,
            pressure,
            gps,
        )

    def _pulses(self) -> list[int]:
        if not self.armed:
            return [int(self.parameters["MOT_PWM_MIN"])] * 4
        motors = [max(m, SPIN_ARM) for m in self._motors()]
        low, high = self.parameters["MOT_PWM_MIN"], self.parameters["MOT_PWM_MAX"]
        return [round(low + (high - low) * min(m, 1.0)) for m in motors]

    def _motors(self) -> tuple[float, ...]:
        fr, rl, fl, rr = self.inner.state().motors
        if self.parameters["FRAME_TYPE"] == 1:
            return fr, rl, fl, rr
        # Outputs for the motors right, left, front, rear.
        thrust, yaw = (fr + rl + fl + rr) / 4, (fr + rl - fl - rr) / 4
        roll, pitch = math.sqrt(2) * (rl + fl - fr - rr) / 4, math.sqrt(2) * (fr + fl - rl - rr) / 4
        return thrust - roll + yaw, thrust + roll + yaw, thrust + pitch - yaw, thrust - pitch - yaw

    # --- modes

    @property
    def armed(self) -> bool:
        return self._armed

    @property
    def position_ok(self) -> bool:
        """True if the EKF uses GPS."""
        return self._position_ok

    @property
    def landed(self) -> Landed:
        return self.inner.state().status.landed

    def arm(self) -> Result:
        if not self._position_ok:
            self.say(2, "Arm: Need Position Estimate")
            return Result.FAILED
        if self.mode in (BRAKE, LAND):
            self.say(2, f"Arm: {'BRAKE' if self.mode == BRAKE else 'LAND'} mode not armable")
            return Result.FAILED
        self.inner.set_mode(Mode.HOLD)
        if self.inner.arm(force=False) is not Result.ACCEPTED:
            self.say(2, "Arm: EKF attitude is bad")
            return Result.FAILED
        if not self._armed:
            self.say(6, "Arming motors")
        self._armed = True
        return Result.ACCEPTED

    def disarm(self) -> Result:
        result = self.inner.disarm(force=False)
        self._follow()
        return Result.ACCEPTED if result is Result.ACCEPTED else Result.FAILED

    def takeoff(self, altitude_m: float) -> Result:
        if not self._armed or self.mode != GUIDED:
            return Result.FAILED
        self._setpoint = None
        return self.inner.takeoff(altitude_m)

    def set_mode(self, mode: int) -> Result:
        if mode not in (STABILIZE, GUIDED, *_BUILTIN):
            self.say(4, f"No such mode {mode}")
            return Result.FAILED
        if mode in _POSITION_MODES and not self._position_ok:
            self.say(4, "Mode change failed: requires position")
            return Result.FAILED
        if mode == GUIDED and self.mode != GUIDED:
            self._setpoint = None
            self.inner.set_mode(Mode.HOLD)
        elif mode in _BUILTIN:
            self.inner.set_mode(_BUILTIN[mode])
        if mode != self.mode:
            self.mode = mode
            self.on_mode()
        return Result.ACCEPTED

    def velocity(self, setpoint: Setpoint) -> None:
        """Take a velocity setpoint; it counts in GUIDED only."""
        if self.mode == GUIDED:
            self._setpoint, self._setpoint_us = setpoint, self.time_us

    def _guide(self) -> None:
        """Hand the velocity that GUIDED flies to the autopilot, which never sees it missing."""
        flying = self._armed and self.inner.flight.phase >= 3
        if self.mode != GUIDED or self._setpoint is None or not flying:
            return
        late = self.time_us - self._setpoint_us > GUID_TIMEOUT_US
        self.inner.offer_setpoint(STOP if late else self._setpoint, self._tick_us)
        if self.inner.flight.mode is not Mode.OFFBOARD:
            self.inner.set_mode(Mode.OFFBOARD)

    def _follow(self) -> None:
        """Update the state from the autopilot's automatic changes."""
        self.inner.take_messages()
        if self._armed and self.inner.flight.phase < 2:
            self._armed = False
            self.say(6, "Disarming motors")
        healthy = self.inner.flight.phase > 0
        if not self._position_ok and healthy and self.time_us >= self._position_us:
            self._position_ok = True
            self.say(6, "EKF3 IMU0 is using GPS")
