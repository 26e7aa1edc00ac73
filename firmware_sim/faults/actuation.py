"""Motors and batteries that fail: pure functions of a command, of a reading."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from airl_mav.faults.kinds import MOTORS
from airl_mav.profiles.vehicle import Battery
from airl_mav.vehicle.rotor import command_for, steady_speed
from firmware_sim.faults.timeline import Acting
from firmware_sim.interfaces import ActuatorControls, BatterySample


def thrust_left(acting: Sequence[Acting]) -> dict[int, float]:
    """Return the share of its thrust that each failing motor has left, by its index from 0."""
    left: dict[int, float] = {}
    for _, fault, *_ in acting:
        motor = MOTORS.index(fault.part)
        left[motor] = left.get(motor, 1.0) * (0.0 if fault.kind == "off" else fault.amount)
    return left


def weakened(
    controls: ActuatorControls, left: Mapping[int, float], thrust_curve: float
) -> ActuatorControls:
    """Return the commands that give healthy motors the thrust that the failing ones have.

    Args:
        controls: What the flight controller commands.
        left: Share of its thrust that each failing motor has left, by its index.
        thrust_curve: Of the airframe (`vehicle.rotor.steady_speed`).
    """
    motors = list(controls.motors)
    for index, share in left.items():
        thrust = share * steady_speed(motors[index], thrust_curve) ** 2
        motors[index] = command_for(thrust, thrust_curve)
    first, second, third, fourth = motors
    return controls._replace(motors=(first, second, third, fourth))


def misread(reading: BatterySample, acting: Sequence[Acting], battery: Battery) -> BatterySample:
    """Return what a power module reads whose battery fails: `off` is empty, `sag` a lower voltage.

    Args:
        reading: Without the faults.
        acting: Faults of the battery.
        battery: The battery.
    """
    for _, fault, *_ in acting:
        if fault.kind == "off":
            empty_v = battery.cells * battery.cell_empty_v
            reading = reading._replace(voltage_v=empty_v, remaining=0.0)
        elif fault.kind == "sag":
            voltage_v = max(0.0, reading.voltage_v - battery.cells * fault.amount)
            reading = reading._replace(voltage_v=voltage_v)
    return reading
