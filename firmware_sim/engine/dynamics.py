"""Forces, power and battery of the vehicle, computed around the body's step in compiled code."""

from __future__ import annotations

import math

from numba.extending import register_jitable

from airl_mav.core.constants import GRAVITY_M_S2
from airl_mav.core.frames import Vector, geodetic_to_local, local_to_geodetic
from airl_mav.core.kernels import kernel
from airl_mav.profiles.vehicle import Battery
from airl_mav.vehicle import atmosphere
from airl_mav.vehicle.airframe import airframe_of, drag_force, settle, wrench
from airl_mav.vehicle.power import (
    drain,
    felt,
    felt_share,
    flight_power_w,
    open_circuit,
    power_model_of,
    standing_power_w,
    terminal_voltage,
)
from airl_mav.vehicle.rotation import Quat, Vec, conjugate, rotate

# Kernels call these functions as Python does.
register_jitable(geodetic_to_local)
register_jitable(local_to_geodetic)
register_jitable(atmosphere.pressure_hpa)
register_jitable(atmosphere.altitude_m)
register_jitable(atmosphere.temperature_c)

WIDTH = 16
"""Number of values in a row."""

POSITION = slice(0, 3)
"""NED [m]."""
VELOCITY = slice(3, 6)
"""NED [m/s]."""
QUATERNION = slice(6, 10)
"""Body -> NED."""
RATES = slice(10, 13)
"""Angular velocity FRD [rad/s]."""
FORCE = slice(13, 16)
"""Specific force FRD [m/s²], as measured by an accelerometer."""


@kernel
def velocity(row: Vector) -> Vec:
    """Return the velocity NED [m/s] of a row (16,)."""
    return row[3], row[4], row[5]


@kernel
def quaternion(row: Vector) -> Quat:
    """Return the attitude body -> NED of a row (16,)."""
    return row[6], row[7], row[8], row[9]


@kernel
def rates(row: Vector) -> Vec:
    """Return the angular velocity FRD [rad/s] of a row (16,)."""
    return row[10], row[11], row[12]


@kernel
def force(row: Vector) -> Vec:
    """Return the specific force FRD [m/s²] of a row (16,)."""
    return row[13], row[14], row[15]


@kernel
def write(p: Vec, v: Vec, q: Quat, omega: Vec, before: Vector, tick_s: float, row: Vector) -> None:
    """Write a motion as a row (16,): position [m], velocity [m/s], attitude, rates [rad/s].

    The acceleration is differenced from the motion `before` (16,) a tick earlier.
    """
    # Acceleration is differenced, so that it includes contacts.
    accel = (
        (v[0] - before[3]) / tick_s,
        (v[1] - before[4]) / tick_s,
        (v[2] - before[5]) / tick_s,
    )
    # An accelerometer measures acceleration minus gravity, in body axes.
    felt = rotate(conjugate(q), (accel[0], accel[1], accel[2] - GRAVITY_M_S2))
    row[0], row[1], row[2] = p
    row[3], row[4], row[5] = v
    row[6], row[7], row[8], row[9] = q
    row[10], row[11], row[12] = omega
    row[13], row[14], row[15] = felt


@kernel
def from_bullet(
    at: Vec,
    orientation: Quat,
    linear: Vec,
    angular: Vec,
    before: Vector,
    tick_s: float,
    row: Vector,
) -> None:
    """Write pybullet's state, in ENU with attitude FLU -> ENU, xyzw, as a row in NED / FRD.

    The attitude NED <- FRD is (half a turn about (1,1,0)) q_enu_flu (half a turn about x); the
    products are expanded. `before` (16,) is the motion a tick earlier.
    """
    x, y, z, w = orientation
    h = math.sqrt(0.5)
    q = (h * (w + z), h * (x + y), h * (x - y), h * (w - z))
    if q[0] < 0.0:
        q = (-q[0], -q[1], -q[2], -q[3])
    body = conjugate(q)
    # ENU to NED: swap the first two axes, negate the third.
    omega = rotate(body, (angular[1], angular[0], -angular[2]))
    p, v = (at[1], at[0], -at[2]), (linear[1], linear[0], -linear[2])
    write(p, v, q, omega, before, tick_s, row)


Speeds = tuple[float, float, float, float]
"""Rotor speeds, as fractions of the speed at full command."""

Supply = tuple[float, float, float, float]
"""Voltage [V], current [A], charge used [mAh], fraction left; as in `BatterySample`."""


def pack_row(battery: Battery) -> tuple[float, ...]:
    """Return voltage empty and full [V], resistance [ohm] and capacity [mAh], for `supply`."""
    cells = battery.cells
    return (
        cells * battery.cell_empty_v,
        cells * battery.cell_full_v,
        battery.resistance_ohm,
        battery.capacity_mah,
    )


@kernel
def actuate(
    speeds: Speeds, motors: Speeds, row: Vector, wind: Vector, airframe: Vector, left: float
) -> tuple[Speeds, Vec, Vec, Vec]:
    """Convert motor commands 0..1 to the force and torque on the body for one tick.

    `row` (16,) is the motion, `wind` (3,) NED [m/s], `airframe` (15,) the fields of `Airframe`,
    `left` the fraction of a speed error that remains after a tick (`airframe.lag`).

    Returns rotor speeds after the tick; in NED the centre of mass [m], the force without gravity
    [N] and the torque [N m].
    """
    a = airframe_of(airframe)
    s = (
        settle(speeds[0], motors[0], a, left),
        settle(speeds[1], motors[1], a, left),
        settle(speeds[2], motors[2], a, left),
        settle(speeds[3], motors[3], a, left),
    )
    thrust, torque = wrench(s[0], s[1], s[2], s[3], a)
    # Forces act at the attitude before the tick.
    q, w, k = quaternion(row), rates(row), a.drag_angular
    lift = rotate(q, (0.0, 0.0, -thrust))
    drag = drag_force(velocity(row), (wind[0], wind[1], wind[2]), a)
    # Angular drag opposes the rates in body axes.
    turn = rotate(q, (torque[0] - k * w[0], torque[1] - k * w[1], torque[2] - k * w[2]))
    here = (row[0], row[1], row[2])
    force = (lift[0] + drag[0], lift[1] + drag[1], lift[2] + drag[2])
    return s, here, force, turn


@kernel
def supply(power: float, charge: float, pack: Vector) -> Supply:
    """Return the battery monitor's reading under a load [W] at a state of charge 0..1."""
    voltage = terminal_voltage(open_circuit(charge, pack[0], pack[1]), pack[2], power)
    return voltage, power / voltage, (1.0 - charge) * pack[3], charge


@kernel
def absorb(
    before: Vector,
    row: Vector,
    wind: Vector,
    speeds: Speeds,
    standing: bool,
    acceleration: Vec,
    charge: float,
    airframe: Vector,
    power: Vector,
    pack: Vector,
    computer_w: float,
    tick_s: float,
) -> tuple[float, Vec, Supply, float]:
    """Compute the power used in a tick and the remaining charge.

    `before` and `row` (16,) are the motion before and after the tick. `standing` is True in contact
    with anything. `acceleration` is the power model's before the tick (`power.felt`) [m/s²].
    `charge` 0..1 is the state before the tick, `pack` holds the values of `pack_row`. `computer_w`
    is the power of the onboard computer from the pack [W]. `airframe` and `power` are fields of
    their models.

    Returns the power over the tick [W], without the computer; the acceleration, the battery
    monitor's reading and the state of charge after the tick.
    """
    m, a = power_model_of(power), airframe_of(airframe)
    thrust, _ = wrench(speeds[0], speeds[1], speeds[2], speeds[3], a)
    if standing:
        # In contact the power model assumes no acceleration.
        acceleration = (0.0, 0.0, 0.0)
        used = standing_power_w(thrust, a, m)
    else:
        # Uses the state before the tick, in which the forces acted, as for the drag.
        older, air = velocity(before), (wind[0], wind[1], wind[2])
        used = flight_power_w(thrust, older, quaternion(before), air, acceleration, a, m)
        kept = felt_share(m, tick_s)
        acceleration = felt(acceleration, older, velocity(row), kept, tick_s, m)
    # The battery also feeds the computer; the returned power is the vehicle's alone.
    reading = supply(used + computer_w, charge, pack)
    return used, acceleration, reading, drain(charge, reading[1], pack[3], tick_s)
