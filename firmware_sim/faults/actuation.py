"""Motors and batteries that fail: pure functions of a command, of a reading."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from airl_mav.faults.kinds import MOTORS
from airl_mav.faults.model import Fault
from airl_mav.profiles.vehicle import Battery
from airl_mav.vehicle.rotor import command_for, steady_speed
from firmware_sim.faults.timeline import Acting
from firmware_sim.interfaces import ActuatorControls, BatterySample


def thrust_left(acting: Sequence[Acting]) -> dict[int, float]:
    """Return the share of its thrust that each failing motor has left, by its index from 0."""
    left: dict[int, float] = {}
    for _, fault, *_ in acting:
        if fault.kind == "slow":
            continue
        motor = MOTORS.index(fault.part)
        left[motor] = left.get(motor, 1.0) * _share(fault)
    return left


def _share(fault: Fault) -> float:
    if fault.kind == "off":
        return 0.0
    return 1.0 + fault.amount if fault.kind == "mismatch" else fault.amount


def slowness(acting: Sequence[Acting]) -> dict[int, float]:
    """Return the factor of its time constant of each motor that is slow, by its index from 0."""
    slow: dict[int, float] = {}
    for _, fault, *_ in acting:
        if fault.kind == "slow":
            motor = MOTORS.index(fault.part)
            slow[motor] = slow.get(motor, 1.0) * fault.amount
    return slow


def weakened(
    controls: ActuatorControls, left: Mapping[int, float], thrust_curve: float
) -> ActuatorControls:
    """Return commands that give healthy motors the thrust of failing ones.

    `left` is the share of its thrust that each failing motor has, by its index. More than 1 is more
    than it should be, up to its greatest thrust.
    """
    motors = list(controls.motors)
    for index, share in left.items():
        thrust = min(1.0, share * steady_speed(motors[index], thrust_curve) ** 2)
        motors[index] = command_for(thrust, thrust_curve)
    first, second, third, fourth = motors
    return controls._replace(motors=(first, second, third, fourth))


def slowed(
    controls: ActuatorControls,
    slow: Mapping[int, float],
    speeds: Sequence[float],
    lag: float,
    thrust_curve: float,
) -> ActuatorControls:
    """Return the commands after which healthy motors have the speeds that slow ones would have.

    A motor of time constant `k tau` keeps the share `lag^(1/k)` of its speed's error over a tick, a
    healthy one `lag` = exp(-dt / tau). It gets as far in that tick where it is told to go a share
    of the way: exactly (1 - lag^(1/k)) / (1 - lag) of it. `slow` has the factor k of each slow
    motor by its index, `speeds` the rotors' now, as shares of that at full command.
    """
    motors = list(controls.motors)
    for index, factor in slow.items():
        now, asked = speeds[index], steady_speed(motors[index], thrust_curve)
        reached = now + (asked - now) * (1.0 - lag ** (1.0 / factor)) / (1.0 - lag)
        motors[index] = command_for(reached * reached, thrust_curve)
    first, second, third, fourth = motors
    return controls._replace(motors=(first, second, third, fourth))


def misread(reading: BatterySample, acting: Sequence[Acting], battery: Battery) -> BatterySample:
    """Return a power module's reading: of a failing battery, empty when `off`, lower by `sag`."""
    for _, fault, *_ in acting:
        if fault.kind == "off":
            empty_v = battery.cells * battery.cell_empty_v
            reading = reading._replace(voltage_v=empty_v, remaining=0.0)
        elif fault.kind == "sag":
            voltage_v = max(0.0, reading.voltage_v - battery.cells * fault.amount)
            reading = reading._replace(voltage_v=voltage_v)
    return reading
