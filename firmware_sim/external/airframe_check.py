"""Ground check of external firmware's configuration: a wrong motor order flips the vehicle."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from airl_mav.profiles.vehicle import CORNERS, COUNTER_CLOCKWISE, Corner, VehicleProfile
from firmware_sim.external.parameter_client import Value, same
from firmware_sim.interfaces import FirmwareMissingError

MOTORS = range(4)

SITL_OUTPUT, HITL_OUTPUT = "PWM_MAIN_FUNC{}", "HIL_ACT_FUNC{}"
"""PX4's parameter for the function of output {}."""

GROUND_LOSS = "NAV_DLL_ACT"
"""PX4's parameter for the action on ground station loss; 0 = disabled."""

_PX4_MOTOR_1 = 101
"""PX4's output function of motor 1 (docs: Actuator Configuration)."""

_PX4_MULTIROTOR = 0

_ARDUPILOT_MOTOR_1 = 33
"""ArduPilot's SERVOn_FUNCTION of motor 1."""

_ARDUPILOT_QUAD_X: Mapping[int, Corner] = dict(enumerate(CORNERS, start=1))
"""Corner of each motor of ArduCopter's quad X: AP_MotorsMatrix, MOTOR_FRAME_TYPE_X."""


@dataclass(frozen=True)
class RequiredAirframe:
    """Required configuration of one kind of firmware."""

    firmware: str
    """Name of the firmware in messages: PX4."""
    motors: Sequence[Corner]
    """Corner of the motor on each output."""
    frame: Mapping[str, Value]
    """Parameters that select the frame and the motors' outputs: only checked, never set."""
    settings: Mapping[str, Value]
    """Parameters and their required values: set if allowed, checked otherwise."""
    problem: Callable[[Mapping[str, Value]], str | None]
    """Return the problem of the frame that the parameters configure; None = no problem."""
    also_read: tuple[str, ...] = ()
    """Additional parameters that must be known."""
    autostart: int = 0

    def names(self) -> list[str]:
        """Return the names of all parameters that must be known."""
        return [*self.also_read, *self.frame, *self.settings]


def px4_airframe(vehicle: VehicleProfile, output: str) -> RequiredAirframe:
    """Return a quad by PX4's control allocation, or raise FirmwareMissingError."""
    px4 = vehicle.px4
    if px4 is None:
        raise _no_table("px4")
    return RequiredAirframe(
        "PX4",
        px4.motors,
        frame={
            "CA_AIRFRAME": _PX4_MULTIROTOR,
            "CA_ROTOR_COUNT": len(MOTORS),
            **{output.format(i + 1): _PX4_MOTOR_1 + CORNERS.index(px4.motors[i]) for i in MOTORS},
        },
        settings={
            "THR_MDL_FAC": vehicle.rotor.thrust_curve,
            **vehicle.rotor.px4_geometry(),
            **px4.parameters,
        },
        problem=partial(_px4_problem, px4.motors, output),
        also_read=(GROUND_LOSS,),
        autostart=px4.airframe,
    )


def _px4_problem(motors: Sequence[Corner], output: str, held: Mapping[str, Value]) -> str | None:
    if held["CA_AIRFRAME"] != _PX4_MULTIROTOR or held["CA_ROTOR_COUNT"] != len(MOTORS):
        return (
            f"PX4 flies CA_AIRFRAME {held['CA_AIRFRAME']} with CA_ROTOR_COUNT "
            f"{held['CA_ROTOR_COUNT']}: expected a multirotor (0) with 4"
        )
    for number, expected in enumerate(motors, start=1):
        name = output.format(number)
        motor = int(held[name]) - _PX4_MOTOR_1
        if motor not in MOTORS:
            return f"PX4's {name} is {held[name]}: expected a motor, 101 to 104"
        found = _corner(held, motor)
        if found != expected:
            return (
                f"PX4's output {number} ({name} = {held[name]}) turns the motor {found} "
                f"(CA_ROTOR{motor}_PX, _PY), the vehicle's is {expected}: wrong motor order"
            )
        turn, positive = float(held[f"CA_ROTOR{motor}_KM"]), expected in COUNTER_CLOCKWISE
        if (turn > 0.0) != positive:
            way = "counter-clockwise" if turn > 0.0 else "clockwise"
            return (
                f"PX4's motor {expected} turns {way} (CA_ROTOR{motor}_KM = {turn:g}), the "
                "vehicle's the other way: wrong motor order"
            )
    return None


def ardupilot_airframe(vehicle: VehicleProfile) -> RequiredAirframe:
    """Return a quad by ArduCopter's frame class, type and outputs; else FirmwareMissingError."""
    copter = vehicle.ardupilot
    if copter is None:
        raise _no_table("ardupilot")
    kind = {"FRAME_CLASS": copter.frame_class, "FRAME_TYPE": copter.frame_type}
    return RequiredAirframe(
        "ArduPilot",
        copter.motors,
        frame={
            f"SERVO{i + 1}_FUNCTION": _ARDUPILOT_MOTOR_1 + CORNERS.index(copter.motors[i])
            for i in MOTORS
        },
        settings={**kind, **copter.parameters},
        problem=partial(_ardupilot_problem, copter.motors, kind),
    )


def refuse_untold(vehicle: VehicleProfile, firmware: str) -> None:
    """Raise FirmwareMissingError for a vehicle with sensors not supported by the firmware."""
    for name in ("vision", "rangefinder", "optical_flow"):
        if getattr(vehicle.sensors, name) is not None:
            raise FirmwareMissingError(
                f"--firmware {firmware}: the vehicle has sensors.{name}, which only builtin and px4"
                " are told of"
            )


def _ardupilot_problem(
    motors: Sequence[Corner], kind: Mapping[str, int], held: Mapping[str, Value]
) -> str | None:
    for name, expected in kind.items():
        if held[name] != expected:
            return f"ArduPilot's {name} is {held[name]}, the vehicle's {expected}: wrong frame"
    for output, corner in enumerate(motors, start=1):
        function = int(held[f"SERVO{output}_FUNCTION"])
        found = _ARDUPILOT_QUAD_X.get(function - _ARDUPILOT_MOTOR_1 + 1)
        if found != corner:
            return (
                f"ArduPilot's output {output} (SERVO{output}_FUNCTION = {function}) turns "
                f"{'no motor' if found is None else 'the motor ' + found}, the vehicle's is "
                f"{corner}: wrong motor order"
            )
    return None


def _no_table(name: str) -> FirmwareMissingError:
    return FirmwareMissingError(
        f"--vehicle: its profile has no table [{name}]: accepted: one like that of quad"
    )


def differences(held: Mapping[str, Value], wanted: Mapping[str, Value]) -> list[str]:
    """Return a description of each parameter that differs from the wanted value."""
    return [
        f"{name} = {held[name]:g} (vehicle: {value:g})"
        for name, value in wanted.items()
        if name in held and not same(held[name], value)
    ]


def _corner(held: Mapping[str, Value], motor: int) -> str:
    forward, right = float(held[f"CA_ROTOR{motor}_PX"]), float(held[f"CA_ROTOR{motor}_PY"])
    return f"{'front' if forward > 0.0 else 'rear'} {'right' if right > 0.0 else 'left'}"
