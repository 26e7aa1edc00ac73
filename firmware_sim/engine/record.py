"""State of one vehicle as records: aircraft, sensor sample, flight controller.

A record is an array with one element of a structured dtype. Compiled code receives it as one
argument; Python reads and writes its fields as views. A copy of the records is a snapshot of the
vehicle. The flight controller reads only the sample, never the true state.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from airl_mav.control import demand, memory
from airl_mav.vehicle import airframe, power
from firmware_sim.autopilot import error_state, recovery, yaw_estimator
from firmware_sim.engine.dynamics import WIDTH

Record = NDArray[Any]
"""Array (1,) of a structured dtype."""

Fields: TypeAlias = Any
"""Element of a record in compiled code, with named fields."""

MAG, PRESSURE, GPS = 1, 2, 4
"""Bits of `measured`: slower sensors with a new sample in this tick."""

IDLE, POSITION, TRAJECTORY, ATTITUDE, RATES = -1, 0, 1, 2, 3
"""Values of `demand_kind`: motors stopped, or the type of demand (`control.demand`)."""

NO_CLIMB, RAMPING, RISING, SETTLING, CLIMB_ENDED = range(5)
"""Values of `climbs`: none, the takeoff ramp on the ground, the climb to near the target altitude,
the rest of the climb in hold, or its end."""

OFF, TRUSTED, SUSPECT = 0, 1, 2
"""Values of `compass` and `gps`; Python checks every sample of a suspect sensor."""

NOTHING, LIFT_OFF, LANDING = 0, 1, 2
"""Values of `detecting`."""

DEMAND_SIZE = 11
"""Number of values in the largest demand."""

FILTERS_SIZE = 8
"""Number of values in the low-pass filters of the control loops."""

OUTPUT_SIZE = 11
"""Number of setpoints of the control loops: attitude (4), rates (3), velocity (3), thrust."""

SEEN, CHANGED, FIRST, WATCHES = 0, 1, 2, 5
"""Columns of `watch`, and the number of its rows: gyro, accelerometer, compass, barometer, GPS.
Times [µs] of the newest sample, the newest change, the first sample; -1 = none yet."""

GYRO_ROW, ACCEL_ROW, MAG_ROW, BARO_ROW, GPS_ROW = range(WATCHES)

_F, _I = np.float64, np.int64

AIRCRAFT = np.dtype(
    [
        # Constants.
        ("airframe", _F, len(airframe.Airframe._fields)),
        ("power_model", _F, len(power.PowerModel._fields)),
        ("pack", _F, 4),
        ("rotor_lag", _F),
        ("computer_w", _F),
        ("tick_s", _F),
        ("rate_hz", _I),
        ("start_us", _I),
        ("moves_us", _I),
        ("closing_m_s", _F),  # maximum speed of an obstacle
        ("reach_m", _F),  # from the centre to the outermost point
        ("clear_m", _F),  # contacts are impossible beyond this
        ("footing_m", _F),  # from the centre to the nearest tipping edge
        # True state.
        ("ticks", _I),
        ("time_us", _I),
        ("motion", _F, WIDTH),
        ("speeds", _F, 4),
        ("acceleration", _F, 3),  # as in the power model
        ("charge", _F),
        ("power_w", _F),
        ("battery", _F, 4),  # voltage [V], current [A], charge used [mAh], charge left 0..1
        ("room_m", _F),  # distance within which nothing can be hit, except the floor at rest
        ("held", _I),  # 1 = the floor can hold it against rotors and wind of the newest tick
        ("resting", _I),  # 1 = rests on the floor, and stays there while held
        # Sensors: noise, biases, schedules.
        ("imu_sigma", _F, 12),
        ("accel_bias", _F, 3),
        ("gyro_bias", _F, 3),
        ("mag_sigma", _F),
        ("baro_noise_pa", _F),
        ("baro_step_pa", _F),
        ("baro_drift_pa", _F),
        ("gps_fitted", _I),
        ("gps_keep", _F),
        ("gps_drive", _F),
        ("gps_error", _F, 3),
        ("gps_noise_m", _F, 3),
        ("gps_noise_m_s", _F),
        ("mag_rate", _F, 3),  # rate [Hz], next sample [µs], period number; the same below
        ("baro_rate", _F, 3),
        ("gps_rate", _F, 3),
        ("noise_at", _I, 5),  # next unused row of each noise block
    ],
    align=True,
)
"""Body, rotors, battery and sensors. SI units, NED and FRD, angles in radians."""

_MEASURED: list[Any] = [
    *((name, _F, 3) for name in ("accel", "gyro", "mag")),
    *((name, _F) for name in ("pressure_hpa", "temperature_c")),
    *((name, _F, 3) for name in ("gps_position", "gps_velocity")),  # NED
]

SAMPLE = np.dtype(
    [
        ("time_us", _I),
        ("measured", _I),
        *_MEASURED,
        ("gps_epv_m", _F),
        ("battery_left", _F),  # 0..1
    ],
    align=True,
)
"""Newest sample of each sensor, the only input of a flight controller from the aircraft."""

CONTROLLER = np.dtype(
    [
        # The newest samples.
        ("time_us", _I),
        ("left", _I),  # measurements of the newest tick left to fuse, from `ticks.estimate`
        *_MEASURED,
        ("battery_left", _F),
        ("watch", _I, (WATCHES, 3)),
        ("looked_at", _F, 6),  # accelerometer and gyro at the last failsafe check
        # Alignment at rest: sums of accelerometer, compass, barometric altitude, fix.
        ("aligned", _I),
        ("rest_since_us", _I),  # -1 = no sample yet
        ("rest_count", _I, 4),  # indices as in `alignment.IMU` etc.
        ("rest_sum", _F, 10),
        # Estimator.
        ("state", _F, error_state.ROW_SIZE),
        ("covariance", _F, (error_state.N_STATES, error_state.N_STATES)),
        ("transition", _F, (error_state.N_STATES, error_state.N_STATES)),
        ("process_noise", _F, error_state.N_STATES),
        ("healthy", _I),
        ("baro_origin_m", _F),
        ("baro_variance", _F),
        ("baro_fused_us", _I),
        ("heading_variance", _F),
        ("heading_fused_us", _I),
        ("flying", _I),
        ("compass", _I),  # OFF, TRUSTED or SUSPECT
        ("gps", _I),  # same values as `compass`
        ("origin", _F, 3),  # latitude, longitude [deg], altitude [m]; NaN = unknown
        ("gps_variance", _F, 2),  # position, velocity
        ("gps_horizontal_us", _I),
        ("gps_vertical_us", _I),
        ("gps_horizontal_h", _F, (4, error_state.N_STATES)),
        ("gps_vertical_h", _F, (2, error_state.N_STATES)),
        ("innovation4", _F, 4),
        ("variance4", _F, 4),
        ("innovation2", _F, 2),
        ("variance2", _F, 2),
        ("velocity_noise", _F),  # variance of GPS velocities, relative to the nominal one
        ("velocity_before", _F, 3),  # deviations of the newest fix; NaN = none yet
        ("accelerations", _F, (recovery.LOOK_BACK, 3)),  # of the newest fixes
        ("fixes", _I),
        ("felt_motion", _F, (yaw_estimator.WINDOW, 2)),  # see `yaw_estimator`
        ("seen_motion", _F, (yaw_estimator.WINDOW, 2)),
        ("motions", _I),
        ("motion_variance", _F),
        ("baro_h", _F, (1, error_state.N_STATES)),
        ("heading_h", _F, (1, error_state.N_STATES)),
        ("innovation", _F, 1),
        ("variance", _F, 1),
        ("yaw_models", _F, (yaw_estimator.N_MODELS, yaw_estimator.MODEL_SIZE)),
        ("yaw_shared", _F, yaw_estimator.SHARED_SIZE),
        ("yaw_gyro", _F, 3 * yaw_estimator.LONGEST),
        ("yaw_accel", _F, 3 * yaw_estimator.LONGEST),
        ("yaw_count", _I),
        # Control.
        ("gains", [(name, _F) for name in demand.Gains._fields]),
        ("filters", _F, FILTERS_SIZE),  # `cascade.filters` of the gains
        ("memory", _F, memory.MEMORY_SIZE),
        ("demand_kind", _I),
        ("demand", _F, DEMAND_SIZE),
        ("output", _F, OUTPUT_SIZE),
        ("motors", _F, 4),
        # Climb of a takeoff, see `autopilot.climb`.
        ("climbs", _I),
        ("climb_us", _I),  # time of the last update; -1 = not started
        ("climb_due_us", _I),
        ("climb", _F, 6),
        ("climb_limits", _F, (3, 3)),
        ("ramp", _F, 5),
        # Land detector.
        ("detecting", _I),  # NOTHING, LIFT_OFF or LANDING
        ("detected", _I),  # 1 = detected in the newest tick
        ("land", _F, 7),  # thresholds of `land_detector.thresholds`
        ("still_since_us", _I),  # -1 = the vehicle is moving
    ],
    align=True,
)
"""Flight controller: samples, estimator, control loops. SI units, NED and FRD."""

TRUE_TICK = np.dtype(
    [("time_us", _I), ("motion", _F, WIDTH), ("power_w", _F), ("charge", _F)], align=True
)
"""State of the aircraft after a tick."""

FLOWN_TICK = np.dtype(
    [
        ("time_us", _I),
        ("healthy", _I),
        ("state", _F, error_state.ROW_SIZE),
        *_MEASURED,
        ("demand_kind", _I),
        ("demand", _F, DEMAND_SIZE),
        ("output", _F, OUTPUT_SIZE),
        ("motors", _F, 4),
        ("battery", _F, 4),
    ],
    align=True,
)
"""State of the flight controller in a tick: sample, estimate, commands."""


def new_aircraft() -> Record:
    """Return an aircraft record without constants, all zero."""
    record = np.zeros(1, AIRCRAFT)
    # Identity attitude: a zero quaternion is no rotation.
    record["motion"][0, 6] = 1.0
    return record


def new_sample() -> Record:
    """Return a record of sensors without measurements."""
    return np.zeros(1, SAMPLE)


def new_controller() -> Record:
    """Return a record of a flight controller after boot."""
    record = np.zeros(1, CONTROLLER)
    # -1 marks times that have not happened.
    never = ("baro_fused_us", "heading_fused_us", "gps_horizontal_us", "gps_vertical_us")
    for name in (*never, "watch", "still_since_us", "rest_since_us", "climb_us"):
        record[name] = -1
    record["origin"] = record["velocity_before"] = np.nan
    record["velocity_noise"] = 1.0
    # NaN: the first pressure never counts as a repetition.
    record["pressure_hpa"] = np.nan
    record["transition"] = np.eye(error_state.N_STATES)
    record["demand_kind"] = IDLE
    return record
