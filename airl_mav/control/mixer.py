"""Control allocation of the quad X: collective and torques -> motor commands.

PX4's ControlAllocationSequentialDesaturation with MC_AIRMODE = 0: roll and pitch before yaw,
thrust is lowered but never raised to make room.
"""

from __future__ import annotations

from airl_mav.control.gains import Gains
from airl_mav.control.velocity import clamp
from airl_mav.core.kernels import kernel
from airl_mav.vehicle.rotation import Vec

Motors = tuple[float, float, float, float]

# Motors FR, RL, FL, RR: command = thrust + arm_roll roll + arm_pitch pitch + yaw.
ROLL: Motors = (-1.0, 1.0, 1.0, -1.0)
PITCH: Motors = (1.0, -1.0, 1.0, -1.0)
YAW: Motors = (1.0, 1.0, -1.0, -1.0)
THRUST: Motors = (1.0, 1.0, 1.0, 1.0)
# Yaw may push motors beyond their limit by this share before thrust gives way.
YAW_MARGIN = 0.15


@kernel
def _add(m: Motors, direction: Motors, amount: float) -> Motors:
    return (
        m[0] + amount * direction[0],
        m[1] + amount * direction[1],
        m[2] + amount * direction[2],
        m[3] + amount * direction[3],
    )


@kernel
def _excess(m: Motors, direction: Motors, high: float) -> float:
    """Return the multiple of `direction` that brings the worst motors back into [0, high]."""
    k_min = 0.0
    k_max = 0.0
    # The multiple that returns each motor to its nearest limit.
    for i in range(4):
        k = 0.0
        if m[i] < 0.0:
            k = -m[i] / direction[i]
        elif m[i] > high:
            k = (high - m[i]) / direction[i]
        k_min = min(k_min, k)
        k_max = max(k_max, k)
    return k_min + k_max


@kernel
def _desaturate(m: Motors, direction: Motors, high: float, lower_only: bool) -> Motors:
    gain = _excess(m, direction, high)
    # Without airmode, thrust may be lowered but not raised.
    if lower_only and gain > 0.0:
        return m
    m = _add(m, direction, gain)
    # Half again: a compromise when motors saturate at both ends.
    return _add(m, direction, 0.5 * _excess(m, direction, high))


@kernel
def _in_range(m: Motors) -> bool:
    low = min(min(m[0], m[1]), min(m[2], m[3]))
    return low >= 0.0 and max(max(m[0], m[1]), max(m[2], m[3])) <= 1.0


@kernel
def mix(thrust: float, torque: Vec, gains: Gains) -> tuple[Motors, Vec]:
    """Return motor commands 0..1 for thrust 0..1 and torque -1..1, and the missing torque."""
    motors, fits = allocate(thrust, torque, gains)
    if fits:
        return motors, (0.0, 0.0, 0.0)  # The usual case
    return desaturate(thrust, torque, gains)


@kernel
def allocate(thrust: float, torque: Vec, gains: Gains) -> tuple[Motors, bool]:
    """Return motor commands without limits, and True if all are in range, with and without yaw."""
    m = _roll_and_pitch(thrust, torque, gains)
    turning = _add(m, YAW, torque[2])
    return turning, _in_range(m) and _in_range(turning)


@kernel
def _roll_and_pitch(thrust: float, torque: Vec, gains: Gains) -> Motors:
    level = (thrust, thrust, thrust, thrust)
    m = _add(level, _scaled(ROLL, gains.mix_roll), torque[0])
    return _add(m, _scaled(PITCH, gains.mix_pitch), torque[1])


@kernel
def _scaled(direction: Motors, share: float) -> Motors:
    return (
        share * direction[0],
        share * direction[1],
        share * direction[2],
        share * direction[3],
    )


@kernel
def desaturate(thrust: float, torque: Vec, gains: Gains) -> tuple[Motors, Vec]:
    """Return the result of `mix` for commands that are partly out of range."""
    r, p = gains.mix_roll, gains.mix_pitch
    rolling, pitching = _scaled(ROLL, r), _scaled(PITCH, p)
    m = _roll_and_pitch(thrust, torque, gains)
    # Order of PX4: lower the thrust, then give up roll, then pitch.
    m = _desaturate(m, THRUST, 1.0, True)
    m = _desaturate(m, rolling, 1.0, False)
    m = _desaturate(m, pitching, 1.0, False)
    # Yaw comes last; its margin lets it act at full thrust.
    m = _add(m, YAW, torque[2])
    m = _desaturate(m, YAW, 1.0 + YAW_MARGIN, False)
    m = _desaturate(m, THRUST, 1.0, True)
    out = (
        clamp(m[0], 0.0, 1.0),
        clamp(m[1], 0.0, 1.0),
        clamp(m[2], 0.0, 1.0),
        clamp(m[3], 0.0, 1.0),
    )
    # The torque that the clamped motors produce; the rest is missing.
    roll = (-out[0] + out[1] + out[2] - out[3]) / (4.0 * r)
    pitch = (out[0] - out[1] + out[2] - out[3]) / (4.0 * p)
    yaw = 0.25 * (out[0] + out[1] - out[2] - out[3])
    missing = (torque[0] - roll, torque[1] - pitch, torque[2] - yaw)
    return out, (_dead(missing[0]), _dead(missing[1]), _dead(missing[2]))


@kernel
def _dead(value: float) -> float:
    """Return 0 for rounding noise: the deficit of a saturated axis is larger."""
    return value if abs(value) > 1e-6 else 0.0
