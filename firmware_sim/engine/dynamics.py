"""Forces, power and battery of the vehicle, computed around the body's step in compiled code."""

from __future__ import annotations

from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from airl_mav.profiles.vehicle import Battery
from airl_mav.vehicle.airframe import airframe_of
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
from airl_mav.vehicle.rigid_body import drag_force
from airl_mav.vehicle.rotation import Vec, rotate
from airl_mav.vehicle.rotor import settle, wrench
from firmware_sim.engine.kinematics import quaternion, rates, velocity

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
    """Convert motor commands to the force and torque on the body for one tick.

    Args:
        speeds: Rotor speeds.
        motors: Commands, 0..1.
        row: (16,) motion of the vehicle.
        wind: (3,) NED [m/s].
        airframe: (15,) fields of `Airframe`.
        left: Fraction of a speed error that remains after a tick (`rotor.lag`).

    Returns:
        Rotor speeds after the tick; in NED the centre of mass [m], the force without gravity [N]
            and the torque [N m].
    """
    a = airframe_of(airframe)
    s = (
        settle(speeds[0], motors[0], a, left),
        settle(speeds[1], motors[1], a, left),
        settle(speeds[2], motors[2], a, left),
        settle(speeds[3], motors[3], a, left),
    )
    thrust, torque = wrench(s[0], s[1], s[2], s[3], a)
    q, w, k = quaternion(row), rates(row), a.drag_angular
    lift = rotate(q, (0.0, 0.0, -thrust))
    drag = drag_force(velocity(row), (wind[0], wind[1], wind[2]), a)
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

    Args:
        before: (16,) motion before the tick.
        row: (16,) motion after the tick.
        wind: (3,) NED [m/s].
        speeds: Rotor speeds.
        standing: True in contact with anything.
        acceleration: Acceleration in the power model before the tick (`power.felt`) [m/s²].
        charge: State of charge before the tick, 0..1.
        airframe: (15,) fields of `Airframe`.
        power: (17,) fields of `PowerModel`.
        pack: (4,) values of `pack_row`.
        computer_w: Power of the onboard computer from the pack [W].
        tick_s: Length of the tick [s].

    Returns:
        Power over the tick [W], without the computer; the acceleration, the battery monitor's
            reading and the state of charge after the tick.
    """
    m, a = power_model_of(power), airframe_of(airframe)
    thrust, _ = wrench(speeds[0], speeds[1], speeds[2], speeds[3], a)
    if standing:
        acceleration = (0.0, 0.0, 0.0)
        used = standing_power_w(thrust, a, m)
    else:
        # Uses the state before the tick, in which the forces acted, as for the drag.
        older, air = velocity(before), (wind[0], wind[1], wind[2])
        used = flight_power_w(thrust, older, quaternion(before), air, acceleration, a, m)
        kept = felt_share(m, tick_s)
        acceleration = felt(acceleration, older, velocity(row), kept, tick_s, m)
    reading = supply(used + computer_w, charge, pack)
    return used, acceleration, reading, drain(charge, reading[1], pack[3], tick_s)
