"""Forces, power and battery of the vehicle, computed around the body's step: compiled."""

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
"""Of the rotors, as fractions of the speed at full command."""

Supply = tuple[float, float, float, float]
"""Voltage [V], current [A], charge used [mAh], share of it that is left; as `BatterySample`."""


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
    """Turn motor commands into the force and torque that act on the body for one tick.

    Args:
        speeds: Of the rotors.
        motors: Commands, 0..1.
        row: (16,) the vehicle's motion.
        wind: (3,) NED [m/s].
        airframe: (15,) as `Airframe`.
        left: Share of a speed error that a tick leaves (`rotor.lag`).

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
    """Work out the power used in a tick and the charge that is left.

    Args:
        before: (16,) the motion before the tick.
        row: (16,) the motion after it.
        wind: (3,) NED [m/s].
        speeds: Of the rotors.
        standing: In touch with something.
        acceleration: As the power model takes it, before the tick (`power.felt`) [m/s²].
        charge: State of charge before the tick, 0..1.
        airframe: (15,) as `Airframe`.
        power: (17,) as `PowerModel`.
        pack: (4,) as `pack_row`.
        computer_w: What the onboard computer draws from the pack [W].
        tick_s: Length of the tick [s].

    Returns:
        Power over the tick [W], without the computer's; the acceleration after it; the battery
        monitor's reading; the state of charge after it.
    """
    m, a = power_model_of(power), airframe_of(airframe)
    thrust, _ = wrench(speeds[0], speeds[1], speeds[2], speeds[3], a)
    if standing:
        acceleration = (0.0, 0.0, 0.0)
        used = standing_power_w(thrust, a, m)
    else:
        # Of the state in which the tick's forces acted, as the drag.
        older, air = velocity(before), (wind[0], wind[1], wind[2])
        used = flight_power_w(thrust, older, quaternion(before), air, acceleration, a, m)
        kept = felt_share(m, tick_s)
        acceleration = felt(acceleration, older, velocity(row), kept, tick_s, m)
    reading = supply(used + computer_w, charge, pack)
    return used, acceleration, reading, drain(charge, reading[1], pack[3], tick_s)
