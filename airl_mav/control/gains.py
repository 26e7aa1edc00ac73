"""Gains and limits of the cascade, taken from PX4-named parameters."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba.np.unsafe.ndarray import to_fixed_tuple
from numpy.typing import NDArray

from airl_mav.core.constants import DEG
from airl_mav.core.kernels import kernel


class Gains(NamedTuple):
    """Everything the cascade needs, SI units and radians; comments name PX4's parameters."""

    pos_p_xy: float  # MPC_XY_P
    pos_p_z: float  # MPC_Z_P
    vel_p_xy: float  # MPC_XY_VEL_P_ACC
    vel_i_xy: float  # MPC_XY_VEL_I_ACC
    vel_d_xy: float  # MPC_XY_VEL_D_ACC
    vel_p_z: float  # MPC_Z_VEL_P_ACC
    vel_i_z: float  # MPC_Z_VEL_I_ACC
    vel_d_z: float  # MPC_Z_VEL_D_ACC
    vel_d_cutoff_hz: float  # MPC_VELD_LP
    vel_max_xy: float  # MPC_XY_VEL_MAX
    vel_max_up: float  # MPC_Z_VEL_MAX_UP
    vel_max_down: float  # MPC_Z_VEL_MAX_DN
    tilt_max: float  # MPC_TILTMAX_AIR
    hover_thrust: float  # MPC_THR_HOVER
    thrust_min: float  # MPC_THR_MIN
    thrust_max: float  # MPC_THR_MAX
    thrust_xy_margin: float  # MPC_THR_XY_MARG
    att_p_roll: float  # MC_ROLL_P
    att_p_pitch: float  # MC_PITCH_P
    att_p_yaw: float  # MC_YAW_P
    yaw_weight: float  # MC_YAW_WEIGHT
    rate_max_roll: float  # MC_ROLLRATE_MAX
    rate_max_pitch: float  # MC_PITCHRATE_MAX
    rate_max_yaw: float  # MC_YAWRATE_MAX
    rate_p_roll: float  # MC_ROLLRATE_P x K
    rate_i_roll: float  # MC_ROLLRATE_I x K
    rate_d_roll: float  # MC_ROLLRATE_D x K
    rate_p_pitch: float
    rate_i_pitch: float
    rate_d_pitch: float
    rate_p_yaw: float
    rate_i_yaw: float
    rate_d_yaw: float
    rate_int_max_roll: float  # MC_RR_INT_LIM
    rate_int_max_pitch: float  # MC_PR_INT_LIM
    rate_int_max_yaw: float  # MC_YR_INT_LIM
    gyro_cutoff_hz: float  # IMU_GYRO_CUTOFF
    dgyro_cutoff_hz: float  # IMU_DGYRO_CUTOFF
    yaw_torque_cutoff_hz: float  # MC_YAW_TQ_CUTOFF
    mix_roll: float  # of a roll torque in each motor's command, CA_ROTORn_PX, CA_ROTORn_PY
    mix_pitch: float  # of a pitch torque

    @classmethod
    def from_parameters(cls, value: Callable[[str], float]) -> Gains:
        """Read all gains through a lookup of PX4 parameter names."""
        k_roll, k_pitch, k_yaw = (
            value("MC_ROLLRATE_K"),
            value("MC_PITCHRATE_K"),
            value("MC_YAWRATE_K"),
        )
        mix_roll, mix_pitch = _allocation(
            sum(abs(value(f"CA_ROTOR{i}_PX")) for i in range(4)),
            sum(abs(value(f"CA_ROTOR{i}_PY")) for i in range(4)),
        )
        return cls(
            pos_p_xy=value("MPC_XY_P"),
            pos_p_z=value("MPC_Z_P"),
            vel_p_xy=value("MPC_XY_VEL_P_ACC"),
            vel_i_xy=value("MPC_XY_VEL_I_ACC"),
            vel_d_xy=value("MPC_XY_VEL_D_ACC"),
            vel_p_z=value("MPC_Z_VEL_P_ACC"),
            vel_i_z=value("MPC_Z_VEL_I_ACC"),
            vel_d_z=value("MPC_Z_VEL_D_ACC"),
            vel_d_cutoff_hz=value("MPC_VELD_LP"),
            vel_max_xy=value("MPC_XY_VEL_MAX"),
            vel_max_up=value("MPC_Z_VEL_MAX_UP"),
            vel_max_down=value("MPC_Z_VEL_MAX_DN"),
            tilt_max=value("MPC_TILTMAX_AIR") * DEG,
            hover_thrust=value("MPC_THR_HOVER"),
            thrust_min=value("MPC_THR_MIN"),
            thrust_max=value("MPC_THR_MAX"),
            thrust_xy_margin=value("MPC_THR_XY_MARG"),
            att_p_roll=value("MC_ROLL_P"),
            att_p_pitch=value("MC_PITCH_P"),
            att_p_yaw=value("MC_YAW_P"),
            yaw_weight=value("MC_YAW_WEIGHT"),
            rate_max_roll=value("MC_ROLLRATE_MAX") * DEG,
            rate_max_pitch=value("MC_PITCHRATE_MAX") * DEG,
            rate_max_yaw=value("MC_YAWRATE_MAX") * DEG,
            rate_p_roll=k_roll * value("MC_ROLLRATE_P"),
            rate_i_roll=k_roll * value("MC_ROLLRATE_I"),
            rate_d_roll=k_roll * value("MC_ROLLRATE_D"),
            rate_p_pitch=k_pitch * value("MC_PITCHRATE_P"),
            rate_i_pitch=k_pitch * value("MC_PITCHRATE_I"),
            rate_d_pitch=k_pitch * value("MC_PITCHRATE_D"),
            rate_p_yaw=k_yaw * value("MC_YAWRATE_P"),
            rate_i_yaw=k_yaw * value("MC_YAWRATE_I"),
            rate_d_yaw=k_yaw * value("MC_YAWRATE_D"),
            rate_int_max_roll=value("MC_RR_INT_LIM"),
            rate_int_max_pitch=value("MC_PR_INT_LIM"),
            rate_int_max_yaw=value("MC_YR_INT_LIM"),
            gyro_cutoff_hz=value("IMU_GYRO_CUTOFF"),
            dgyro_cutoff_hz=value("IMU_DGYRO_CUTOFF"),
            yaw_torque_cutoff_hz=value("MC_YAW_TQ_CUTOFF"),
            mix_roll=mix_roll,
            mix_pitch=mix_pitch,
        )


LEAST_ARM = 1e-6
"""Arms along one axis that are shorter than this share of those along the other one are taken for
missing: no motor command would turn such a vehicle about that axis."""


def _allocation(forward: float, right: float) -> tuple[float, float]:
    """Return the share of a roll and of a pitch torque in each motor's command.

    The pseudo-inverse of a quad X, normalised as PX4's ControlAllocationPseudoInverse does it: one
    scale for both axes, so that the weaker one moves a motor by sin 45 deg.
    """
    weaker = min(forward, right)
    if weaker <= LEAST_ARM * max(forward, right):
        return math.sqrt(0.5), math.sqrt(0.5)
    return math.sqrt(0.5) * weaker / right, math.sqrt(0.5) * weaker / forward


_COUNT = len(Gains._fields)


def pack(gains: Gains) -> NDArray[np.float64]:
    """Return the gains as a row of floats, which numba passes faster than a tuple."""
    return np.array(gains, np.float64)


@kernel
def unpack(row: NDArray[np.float64]) -> Gains:
    """Return the gains of a row by their names. The inverse of `pack`, for compiled code."""
    return Gains(*to_fixed_tuple(row, _COUNT))
