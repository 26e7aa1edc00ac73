"""VIBRATION: PX4's running vibration metrics of the IMU."""

from __future__ import annotations

import math

import numpy as np

from airl_mav.core.constants import GRAVITY_M_S2, US_PER_S
from airl_mav.core.kernels import kernel
from firmware_sim.autopilot.autopilot_state import AutopilotState, Vector
from firmware_sim.engine.record import Record
from firmware_sim.mavlink.codec import Values

_OLD, _NEW = 0.99, 0.01
"""Filter weights per sample (PX4 VehicleIMU::UpdateAccelVibrationMetrics)."""

_CLIP_M_S2 = 16.0 * GRAVITY_M_S2
"""Range of PX4's simulated accelerometer [m/s²]."""

# What the meter remembers: the four metrics, and the last sample (time, gyro, accel).
_CONING, _GYRO, _ACCEL, _CLIPPED, _LAST_US, _LAST_GYRO, _LAST_ACCEL, _SIZE = 0, 1, 2, 3, 4, 5, 8, 11


class VibrationMeter:
    """Filters every IMU sample; PX4's use of the fields differs from the MAVLink text.

    vibration_x: coning, filtered |delta angle x previous delta angle| [rad²]; vibration_y:
    filtered |gyro - previous gyro| [rad/s]; vibration_z: filtered |accel - previous accel|
    [m/s²]; clipping_0: samples at the end of the accelerometer's range.
    """

    def __init__(self) -> None:
        self._memory = np.zeros(_SIZE)
        self._memory[_LAST_US] = math.nan

    def update(self, flown: Record) -> None:
        """Take in the samples of ticks (n,), each once (`engine.record.FLOWN_TICK`)."""
        _update(self._memory, flown)

    def message(self, state: AutopilotState) -> Values:
        """Return VIBRATION. There is one accelerometer."""
        coning, gyro, accel, clipped = self._memory[: _CLIPPED + 1].tolist()
        clipping_1 = clipping_2 = 0
        return state.time_us, coning, gyro, accel, int(clipped), clipping_1, clipping_2


@kernel
def _update(memory: Vector, flown: Record) -> None:
    """Filter the samples of ticks (n,) into `memory` (11,)."""
    for k in range(len(flown)):
        _filter(memory, flown[k].time_us, flown[k].gyro, flown[k].accel)


@kernel
def _filter(memory: Vector, time_us: int, gyro: Vector, accel: Vector) -> None:
    """Filter one sample into `memory` (11,); gyro (3,) FRD [rad/s], accel (3,) FRD [m/s²]."""
    clipped = False
    last_gyro, last_accel = memory[_LAST_GYRO:_LAST_ACCEL], memory[_LAST_ACCEL:_SIZE]
    if not math.isnan(memory[_LAST_US]):
        dt = (time_us - memory[_LAST_US]) / US_PER_S
        cross, gyro_step, accel_step = 0.0, 0.0, 0.0
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            cross += (gyro[j] * last_gyro[k] - gyro[k] * last_gyro[j]) ** 2
            gyro_step += (gyro[i] - last_gyro[i]) ** 2
            accel_step += (accel[i] - last_accel[i]) ** 2
        memory[_CONING] = _OLD * memory[_CONING] + _NEW * dt * dt * math.sqrt(cross)
        memory[_GYRO] = _OLD * memory[_GYRO] + _NEW * math.sqrt(gyro_step)
        memory[_ACCEL] = _OLD * memory[_ACCEL] + _NEW * math.sqrt(accel_step)
    for i in range(3):
        last_gyro[i], last_accel[i] = gyro[i], accel[i]
        clipped = clipped or abs(accel[i]) >= _CLIP_M_S2
    memory[_LAST_US] = time_us
    memory[_CLIPPED] += clipped
