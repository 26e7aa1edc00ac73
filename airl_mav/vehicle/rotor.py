"""Rotors: command -> speed (first-order lag) -> thrust and torque.

PX4 quad-X order: 0 front right, 1 rear left, 2 front left, 3 rear right; 0 and 1 turn
counter-clockwise seen from above. Speeds are fractions of the speed at full command.
"""

from __future__ import annotations

import math

from airl_mav.core.constants import GRAVITY_M_S2
from airl_mav.core.kernels import kernel
from airl_mav.vehicle.airframe import Airframe
from airl_mav.vehicle.rotation import Vec

N_ROTORS = 4
# Position of each rotor relative to their centre, as signs of the arms (forward, right).
FORWARD_SIGN = (1.0, -1.0, 1.0, -1.0)
RIGHT_SIGN = (1.0, -1.0, -1.0, 1.0)
# Reaction torque on the body about the down axis: a rotor turning counter-clockwise pushes the
# body clockwise, which is positive yaw.
YAW_SIGN = (1.0, 1.0, -1.0, -1.0)


@kernel
def steady_speed(command: float, thrust_curve: float) -> float:
    """Return the steady speed fraction 0..1 of a command 0..1 (thrust ~ speed²)."""
    u = min(1.0, max(0.0, command))
    return math.sqrt(thrust_curve * u * u + (1.0 - thrust_curve) * u)


@kernel
def lag(airframe: Airframe, dt: float) -> float:
    """Return the share of a speed error that remains after dt [s]: exact for a first-order lag."""
    return math.exp(-dt / airframe.rotor_time_constant)


@kernel
def settle(speed: float, command: float, airframe: Airframe, left: float) -> float:
    """Return the speed fraction after a step that leaves the share `left` of the error."""
    target = steady_speed(command, airframe.thrust_curve)
    return target + (speed - target) * left


@kernel
def command_for(thrust: float, thrust_curve: float) -> float:
    """Return the command 0..1 for a share 0..1 of maximum thrust in steady state."""
    c = thrust_curve
    if c == 0.0:
        return thrust
    b = 1.0 - c
    return (math.sqrt(b * b + 4.0 * c * thrust) - b) / (2.0 * c)


@kernel
def wrench(s0: float, s1: float, s2: float, s3: float, airframe: Airframe) -> tuple[float, Vec]:
    """Return collective thrust [N] along body up, and the body torque FRD [N m]."""
    speeds = (s0, s1, s2, s3)
    thrust = 0.0
    roll = 0.0
    pitch = 0.0
    yaw = 0.0
    for i in range(N_ROTORS):
        t = airframe.thrust_max * speeds[i] * speeds[i]
        thrust += t
        # torque = r x F with F = (0, 0, -t) at r = (forward, right, .) from the centre of mass
        roll -= (RIGHT_SIGN[i] * airframe.arm_right - airframe.com_right) * t
        pitch += (FORWARD_SIGN[i] * airframe.arm_forward - airframe.com_forward) * t
        yaw += YAW_SIGN[i] * airframe.torque_per_thrust * t
    return thrust, (roll, pitch, yaw)


def hover_speeds(airframe: Airframe) -> tuple[float, float, float, float]:
    """Return the rotors' speed fractions in a hover, which carry the weight without torque.

    Rotors closer to the centre of mass carry more.
    """
    share = airframe.mass * GRAVITY_M_S2 / (N_ROTORS * airframe.thrust_max)
    right, forward = (
        airframe.com_right / airframe.arm_right,
        airframe.com_forward / airframe.arm_forward,
    )
    s0, s1, s2, s3 = (
        math.sqrt(max(0.0, share * (1.0 + RIGHT_SIGN[i] * right + FORWARD_SIGN[i] * forward)))
        for i in range(N_ROTORS)
    )
    return s0, s1, s2, s3
