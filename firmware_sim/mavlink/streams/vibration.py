"""VIBRATION: PX4's running vibration metrics of the IMU."""

from __future__ import annotations

import math

from airl_mav.constants import GRAVITY_M_S2, US_PER_S
from firmware_sim.autopilot.state import AutopilotState
from firmware_sim.mavlink.codec import WireMessage, dialect

_OLD, _NEW = 0.99, 0.01
"""Filter weights per sample (PX4 VehicleIMU::UpdateAccelVibrationMetrics)."""

_CLIP_M_S2 = 16.0 * GRAVITY_M_S2
"""Range of PX4's simulated accelerometer [m/s²]."""


class VibrationMeter:
    """Filters every IMU sample; PX4's use of the fields differs from the MAVLink text.

    vibration_x: coning, filtered |delta angle x previous delta angle| [rad²]; vibration_y:
    filtered |gyro - previous gyro| [rad/s]; vibration_z: filtered |accel - previous accel|
    [m/s²]; clipping_0: samples at the end of the accelerometer's range.
    """

    def __init__(self) -> None:
        self._coning = self._gyro = self._accel = 0.0
        self._clipped = 0
        self._last: tuple[int, list[float], list[float]] | None = None

    def update(self, state: AutopilotState) -> None:
        """Take in the newest sample; call once per tick."""
        gyro, accel = state.gyro.tolist(), state.accel.tolist()
        if self._last is not None:
            last_us, last_gyro, last_accel = self._last
            dt = (state.time_us - last_us) / US_PER_S
            self._coning = _OLD * self._coning + _NEW * dt * dt * _cross_norm(gyro, last_gyro)
            self._gyro = _OLD * self._gyro + _NEW * math.dist(gyro, last_gyro)
            self._accel = _OLD * self._accel + _NEW * math.dist(accel, last_accel)
        self._last = (state.time_us, gyro, accel)
        self._clipped += max(map(abs, accel)) >= _CLIP_M_S2

    def message(self, state: AutopilotState) -> WireMessage:
        """Return VIBRATION."""
        return dialect.MAVLink_vibration_message(
            state.time_us, self._coning, self._gyro, self._accel, self._clipped, 0, 0
        )


def _cross_norm(a: list[float], b: list[float]) -> float:
    return math.hypot(
        a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    )
