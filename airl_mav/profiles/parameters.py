"""PX4-named parameters of the flight controller: names, defaults, ranges.

The rehearsal's flight controller serves them over MAVLink; training reads its gains from them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from airl_mav.core.errors import UsageError


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """One parameter: its type follows from the default (int = INT32, float = REAL32)."""

    name: str
    default: int | float
    low: float
    high: float
    unit: str
    meaning: str


_s = ParameterSpec


# Names, meanings, defaults and ranges are PX4's (parameter reference of v1.16). It leaves where the
# rotors are (CA_ROTORn_PX, _PY) to the airframe: here as in vehicles/quad.
SPECS: tuple[ParameterSpec, ...] = (
    _s("BAT1_CAPACITY", 5200.0, -1, 1e6, "mAh", "battery capacity"),
    _s("BAT1_N_CELLS", 4, 0, 16, "", "cells in series"),
    _s("BAT_CRIT_THR", 0.07, 0.05, 0.5, "", "critical battery threshold"),
    _s("BAT_EMERGEN_THR", 0.05, 0.03, 0.5, "", "emergency battery threshold"),
    _s("BAT_LOW_THR", 0.15, 0.12, 0.5, "", "low battery threshold"),
    _s("CAL_ACC0_ID", 1310988, 0, 2**31 - 1, "", "calibrated accelerometer (simulated)"),
    _s("CAL_GYRO0_ID", 1310988, 0, 2**31 - 1, "", "calibrated gyroscope (simulated)"),
    _s("CAL_MAG0_ID", 197388, 0, 2**31 - 1, "", "calibrated magnetometer (simulated)"),
    _s("CA_ROTOR0_PX", 0.13, -100, 100, "m", "rotor 0: how far forward of the centre"),
    _s("CA_ROTOR0_PY", 0.22, -100, 100, "m", "rotor 0: how far right of the centre"),
    _s("CA_ROTOR1_PX", -0.13, -100, 100, "m", "rotor 1: how far forward of the centre"),
    _s("CA_ROTOR1_PY", -0.22, -100, 100, "m", "rotor 1: how far right of the centre"),
    _s("CA_ROTOR2_PX", 0.13, -100, 100, "m", "rotor 2: how far forward of the centre"),
    _s("CA_ROTOR2_PY", -0.22, -100, 100, "m", "rotor 2: how far right of the centre"),
    _s("CA_ROTOR3_PX", -0.13, -100, 100, "m", "rotor 3: how far forward of the centre"),
    _s("CA_ROTOR3_PY", 0.22, -100, 100, "m", "rotor 3: how far right of the centre"),
    _s("COM_DISARM_LAND", 2.0, -1, 20, "s", "time to disarm after landing; <= 0 never"),
    _s("COM_DISARM_PRFLT", 10.0, -1, 30, "s", "time to disarm without take-off; <= 0 never"),
    _s("COM_DL_LOSS_T", 10, 5, 300, "s", "ground station loss timeout"),
    _s("COM_LOW_BAT_ACT", 0, 0, 3, "", "0 warn, 2 land at critical, 3 return, then land"),
    _s(
        "COM_OBL_RC_ACT",
        0,
        0,
        7,
        "",
        "offboard loss: 0 position, 3 return, 4 land, 5 hold, 7 disarm",
    ),
    _s("COM_OF_LOSS_T", 1.0, 0, 60, "s", "offboard loss timeout"),
    _s("COM_RC_IN_MODE", 1, 0, 4, "", "1 = joystick only: no remote control is expected"),
    _s("COM_SPOOLUP_TIME", 1.0, 0, 30, "s", "time from arming to take-off thrust"),
    _s("EKF2_ACC_B_NOISE", 0.003, 0, 0.01, "m/s³", "accelerometer bias process noise"),
    _s("EKF2_ACC_NOISE", 0.35, 0.01, 1, "m/s²", "accelerometer noise"),
    _s("EKF2_BARO_NOISE", 3.5, 0.01, 15, "m", "barometer noise"),
    _s("EKF2_GPS_P_NOISE", 0.5, 0.01, 10, "m", "GPS horizontal position noise"),
    _s("EKF2_GPS_V_NOISE", 0.3, 0.01, 5, "m/s", "GPS velocity noise"),
    _s("EKF2_GYR_B_NOISE", 0.001, 0, 0.01, "rad/s²", "gyroscope bias process noise"),
    _s("EKF2_GYR_NOISE", 0.015, 0.0001, 0.1, "rad/s", "gyroscope noise"),
    _s("EKF2_HEAD_NOISE", 0.3, 0.01, 1, "rad", "magnetic heading noise"),
    _s("IMU_DGYRO_CUTOFF", 30.0, 0, 1000, "Hz", "low-pass of the angular acceleration"),
    _s("IMU_GYRO_CUTOFF", 40.0, 0, 1000, "Hz", "low-pass of the body rates"),
    _s("LNDMC_TRIG_TIME", 1.0, 0.1, 10, "s", "landing detection time"),
    _s("LNDMC_XY_VEL_MAX", 1.5, 0, 20, "m/s", "horizontal speed that still counts as landed"),
    _s("LNDMC_Z_VEL_MAX", 0.25, 0, 10, "m/s", "vertical speed that still counts as landed"),
    _s("MAV_SYS_ID", 1, 1, 1, "", "MAVLink system id (fixed)"),
    _s("MAV_TYPE", 2, 2, 2, "", "MAVLink vehicle type: quadrotor (fixed)"),
    _s("MC_PITCHRATE_D", 0.003, 0, 0.1, "", "pitch rate D"),
    _s("MC_PITCHRATE_I", 0.2, 0, 10, "", "pitch rate I"),
    _s("MC_PITCHRATE_K", 1.0, 0.01, 5, "", "pitch rate gain"),
    _s("MC_PITCHRATE_MAX", 220.0, 0, 1800, "deg/s", "pitch rate limit"),
    _s("MC_PITCHRATE_P", 0.15, 0.01, 0.6, "", "pitch rate P"),
    _s("MC_PITCH_P", 6.5, 0, 12, "1/s", "pitch P"),
    _s("MC_PR_INT_LIM", 0.3, 0, 10, "", "pitch rate integral limit"),
    _s("MC_ROLLRATE_D", 0.003, 0, 0.1, "", "roll rate D"),
    _s("MC_ROLLRATE_I", 0.2, 0, 10, "", "roll rate I"),
    _s("MC_ROLLRATE_K", 1.0, 0.01, 5, "", "roll rate gain"),
    _s("MC_ROLLRATE_MAX", 220.0, 0, 1800, "deg/s", "roll rate limit"),
    _s("MC_ROLLRATE_P", 0.15, 0.01, 0.5, "", "roll rate P"),
    _s("MC_ROLL_P", 6.5, 0, 12, "1/s", "roll P"),
    _s("MC_RR_INT_LIM", 0.3, 0, 10, "", "roll rate integral limit"),
    _s("MC_YAWRATE_D", 0.0, 0, 10, "", "yaw rate D"),
    _s("MC_YAWRATE_I", 0.1, 0, 10, "", "yaw rate I"),
    _s("MC_YAWRATE_K", 1.0, 0, 5, "", "yaw rate gain"),
    _s("MC_YAWRATE_MAX", 200.0, 0, 1800, "deg/s", "yaw rate limit"),
    _s("MC_YAWRATE_P", 0.2, 0, 0.6, "", "yaw rate P"),
    _s("MC_YAW_P", 2.8, 0, 5, "1/s", "yaw P"),
    _s("MC_YAW_TQ_CUTOFF", 2.0, 0, 10, "Hz", "low-pass of the yaw torque"),
    _s("MC_YAW_WEIGHT", 0.4, 0.1, 1, "", "yaw weight"),
    _s("MC_YR_INT_LIM", 0.3, 0, 10, "", "yaw rate integral limit"),
    _s("MIS_TAKEOFF_ALT", 2.5, 0, 80, "m", "default take-off altitude"),
    _s("MPC_ACC_DOWN_MAX", 3.0, 2, 15, "m/s²", "downward acceleration limit"),
    _s("MPC_ACC_UP_MAX", 4.0, 2, 15, "m/s²", "upward acceleration limit"),
    _s("MPC_JERK_AUTO", 4.0, 1, 80, "m/s³", "jerk limit in automatic modes"),
    _s("MPC_LAND_ALT1", 10.0, 0, 122, "m", "height below which landing slows down"),
    _s("MPC_LAND_ALT2", 5.0, 1, 10, "m", "height below which landing is slow"),
    _s("MPC_LAND_SPEED", 0.7, 0.6, 10, "m/s", "landing descent rate"),
    _s("MPC_THR_HOVER", 0.5, 0.1, 0.8, "", "hover thrust"),
    _s("MPC_THR_MAX", 1.0, 0, 1, "", "greatest collective thrust"),
    _s("MPC_THR_MIN", 0.12, 0.05, 0.5, "", "least collective thrust"),
    _s("MPC_THR_XY_MARG", 0.3, 0, 0.5, "", "horizontal thrust margin"),
    _s("MPC_TILTMAX_AIR", 45.0, 20, 89, "deg", "tilt limit"),
    _s("MPC_TKO_RAMP_T", 3.0, 0, 5, "s", "take-off ramp time"),
    _s("MPC_TKO_SPEED", 1.5, 1, 5, "m/s", "take-off climb rate"),
    _s("MPC_VELD_LP", 5.0, 0, 10, "Hz", "low-pass of the velocity derivative"),
    _s("MPC_XY_CRUISE", 5.0, 3, 20, "m/s", "speed in automatic modes"),
    _s("MPC_XY_P", 0.95, 0, 2, "1/s", "horizontal position P"),
    _s("MPC_XY_VEL_D_ACC", 0.2, 0.1, 2, "", "horizontal velocity D"),
    _s("MPC_XY_VEL_I_ACC", 0.4, 0, 60, "", "horizontal velocity I"),
    _s("MPC_XY_VEL_MAX", 12.0, 0, 20, "m/s", "horizontal speed limit"),
    _s("MPC_XY_VEL_P_ACC", 1.8, 1.2, 5, "", "horizontal velocity P"),
    _s("MPC_Z_P", 1.0, 0.1, 1.5, "1/s", "vertical position P"),
    _s("MPC_Z_VEL_D_ACC", 0.0, 0, 2, "", "vertical velocity D"),
    _s("MPC_Z_VEL_I_ACC", 2.0, 0.2, 3, "", "vertical velocity I"),
    _s("MPC_Z_VEL_MAX_DN", 1.5, 0.5, 4, "m/s", "descent limit"),
    _s("MPC_Z_VEL_MAX_UP", 3.0, 0.5, 8, "m/s", "climb limit"),
    _s("MPC_Z_VEL_P_ACC", 4.0, 2, 15, "", "vertical velocity P"),
    _s("MPC_Z_V_AUTO_DN", 1.5, 0.5, 4, "m/s", "descent rate in automatic modes"),
    _s("MPC_Z_V_AUTO_UP", 3.0, 0.5, 8, "m/s", "climb rate in automatic modes"),
    _s("NAV_ACC_RAD", 2.0, 0.05, 200, "m", "acceptance radius"),
    _s("NAV_DLL_ACT", 0, 0, 0, "", "ground station loss: 0 = nothing (fixed)"),
    _s("NAV_MC_ALT_RAD", 0.8, 0.05, 200, "m", "altitude acceptance radius"),
    _s("RTL_RETURN_ALT", 60.0, 0, 1000, "m", "return: height above home to fly at"),
    _s("SYS_AUTOSTART", 10016, 0, 9999999, "", "airframe"),
    _s("SYS_HAS_MAG", 1, 0, 3, "", "number of magnetometers"),
)


def parameter_values(overrides: Mapping[str, int | float]) -> dict[str, int | float]:
    """Return the values of all parameters: the defaults, and a vehicle profile's overrides.

    Raises:
        UsageError: An override is unknown or out of range.
    """
    values = {spec.name: spec.default for spec in SPECS}
    specs = {spec.name: spec for spec in SPECS}
    for name, value in overrides.items():
        spec = specs.get(name)
        if spec is None:
            raise UsageError(f"parameters.{name}: no such parameter")
        if not spec.low <= value <= spec.high:
            raise UsageError(
                f"parameters.{name} = {value}: accepted: "
                f"{spec.low:g} <= value <= {spec.high:g} {spec.unit}".rstrip()
            )
        if isinstance(spec.default, int) and value != int(value):
            raise UsageError(f"parameters.{name} = {value}: accepted: a whole number")
        values[name] = type(spec.default)(value)
    return values
