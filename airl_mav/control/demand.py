"""Demands of the cascade, one kind for each entry point, and its gains from PX4's parameters."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, NamedTuple, get_origin, get_type_hints

from airl_mav.core.constants import DEG
from airl_mav.vehicle.rotation import Quat, Vec


class Demand(NamedTuple):
    """Setpoint of the cascade; NaN = not commanded."""

    position: Vec
    """NED [m]."""
    velocity: Vec
    """NED [m/s]."""
    yaw: float
    """Heading [rad]; NaN with a yaw rate = the current heading."""
    yaw_rate: float
    """[rad/s] about the world's down axis."""


class TrajectoryDemand(NamedTuple):
    """Demand with an acceleration: PX4's trajectory setpoint, any mixture of axes."""

    position: Vec
    """NED [m]."""
    velocity: Vec
    """NED [m/s]: alone, or fed forward to the position's correction."""
    acceleration: Vec
    """NED [m/s²]: alone, or fed forward to the velocity's correction."""
    yaw: float
    """Heading [rad]; NaN with a yaw rate = the current heading."""
    yaw_rate: float
    """[rad/s] about the world's down axis."""


class AttitudeDemand(NamedTuple):
    """Input of the attitude loop, without velocity control."""

    attitude: Quat
    """Body -> NED."""
    yaw_rate: float
    """Fed forward, about the world's down axis [rad/s]."""
    thrust: float
    """Collective 0..1."""


class RateDemand(NamedTuple):
    """Input of the rate loop, without attitude control."""

    rates: Vec
    """Body rates FRD [rad/s]."""
    thrust: float
    """Collective 0..1."""


KIND_US = 500_000
"""Interval of changes between kinds of offboard setpoint [µs]: PX4 accepts another kind when it
publishes its control mode, twice a second, counted from its last status change, such as the switch
to Offboard. Until then it flies the last setpoint of the previous kind. Source: PX4 1.16,
Commander::run (vehicle_control_mode); measured: from velocities to body rates it took 0.5 s."""

AnyDemand = Demand | TrajectoryDemand | AttitudeDemand | RateDemand
"""Inputs of `Controller.fly`."""


class Gains(NamedTuple):
    """Gains of the cascade, in SI units and radians.

    Each is the product of the factors in its annotation: PX4's parameters, and a unit.
    """

    pos_p_xy: Annotated[float, "MPC_XY_P"]
    pos_p_z: Annotated[float, "MPC_Z_P"]
    vel_p_xy: Annotated[float, "MPC_XY_VEL_P_ACC"]
    vel_i_xy: Annotated[float, "MPC_XY_VEL_I_ACC"]
    vel_d_xy: Annotated[float, "MPC_XY_VEL_D_ACC"]
    vel_p_z: Annotated[float, "MPC_Z_VEL_P_ACC"]
    vel_i_z: Annotated[float, "MPC_Z_VEL_I_ACC"]
    vel_d_z: Annotated[float, "MPC_Z_VEL_D_ACC"]
    vel_d_cutoff_hz: Annotated[float, "MPC_VELD_LP"]
    vel_max_xy: Annotated[float, "MPC_XY_VEL_MAX"]
    vel_max_up: Annotated[float, "MPC_Z_VEL_MAX_UP"]
    vel_max_down: Annotated[float, "MPC_Z_VEL_MAX_DN"]
    tilt_max: Annotated[float, "MPC_TILTMAX_AIR", DEG]
    hover_thrust: Annotated[float, "MPC_THR_HOVER"]
    thrust_min: Annotated[float, "MPC_THR_MIN"]
    thrust_max: Annotated[float, "MPC_THR_MAX"]
    thrust_xy_margin: Annotated[float, "MPC_THR_XY_MARG"]
    att_p_roll: Annotated[float, "MC_ROLL_P"]
    att_p_pitch: Annotated[float, "MC_PITCH_P"]
    att_p_yaw: Annotated[float, "MC_YAW_P"]
    yaw_weight: Annotated[float, "MC_YAW_WEIGHT"]
    ref_w_n: Annotated[float, "MC_REF_W_N"]
    rate_max_roll: Annotated[float, "MC_ROLLRATE_MAX", DEG]
    rate_max_pitch: Annotated[float, "MC_PITCHRATE_MAX", DEG]
    rate_max_yaw: Annotated[float, "MC_YAWRATE_MAX", DEG]
    rate_p_roll: Annotated[float, "MC_ROLLRATE_P", "MC_ROLLRATE_K"]
    rate_i_roll: Annotated[float, "MC_ROLLRATE_I", "MC_ROLLRATE_K"]
    rate_d_roll: Annotated[float, "MC_ROLLRATE_D", "MC_ROLLRATE_K"]
    rate_p_pitch: Annotated[float, "MC_PITCHRATE_P", "MC_PITCHRATE_K"]
    rate_i_pitch: Annotated[float, "MC_PITCHRATE_I", "MC_PITCHRATE_K"]
    rate_d_pitch: Annotated[float, "MC_PITCHRATE_D", "MC_PITCHRATE_K"]
    rate_p_yaw: Annotated[float, "MC_YAWRATE_P", "MC_YAWRATE_K"]
    rate_i_yaw: Annotated[float, "MC_YAWRATE_I", "MC_YAWRATE_K"]
    rate_d_yaw: Annotated[float, "MC_YAWRATE_D", "MC_YAWRATE_K"]
    rate_int_max_roll: Annotated[float, "MC_RR_INT_LIM"]
    rate_int_max_pitch: Annotated[float, "MC_PR_INT_LIM"]
    rate_int_max_yaw: Annotated[float, "MC_YR_INT_LIM"]
    gyro_cutoff_hz: Annotated[float, "IMU_GYRO_CUTOFF"]
    dgyro_cutoff_hz: Annotated[float, "IMU_DGYRO_CUTOFF"]
    yaw_torque_cutoff_hz: Annotated[float, "MC_YAW_TQ_CUTOFF"]
    mix_roll: float
    """Share of a roll torque in each motor's command, by CA_ROTORn_PX, CA_ROTORn_PY."""
    mix_pitch: float
    """Share of a pitch torque."""

    @classmethod
    def from_parameters(cls, value: Callable[[str], float]) -> Gains:
        """Read all gains through a lookup of PX4 parameter names."""
        # The arms come from PX4's control allocation geometry.
        shares = _allocation(
            sum(abs(value(f"CA_ROTOR{i}_PX")) for i in range(4)),
            sum(abs(value(f"CA_ROTOR{i}_PY")) for i in range(4)),
        )
        read = [
            math.prod(value(each) if isinstance(each, str) else each for each in factors)
            for factors in _FACTORS
        ]
        return cls._make([*read, *shares])


_FACTORS = [
    hint.__metadata__
    for hint in get_type_hints(Gains, include_extras=True).values()
    if get_origin(hint) is Annotated
]
"""Factors of the gains that are parameters, in their order."""

LEAST_ARM = 1e-6
"""Minimum ratio of the arms along one axis to the other axis. Shorter arms count as missing: no
motor command could turn such a vehicle about that axis."""


def _allocation(forward: float, right: float) -> tuple[float, float]:
    """Return the share of a roll and of a pitch torque in each motor's command.

    The pseudo-inverse of a quad X, normalised as PX4's ControlAllocationPseudoInverse does it: one
    scale for both axes, so that the weaker one moves a motor by sin 45 deg.
    """
    weaker = min(forward, right)
    # A vehicle without arms along an axis keeps both scales.
    if weaker <= LEAST_ARM * max(forward, right):
        return math.sqrt(0.5), math.sqrt(0.5)
    return math.sqrt(0.5) * weaker / right, math.sqrt(0.5) * weaker / forward
