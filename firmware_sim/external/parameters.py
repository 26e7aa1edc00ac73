"""Parameters of real firmware: required configuration of a vehicle, and parameter files.

The configuration is checked on the ground: a wrong motor order flips the vehicle.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from airl_mav.core import errors, files
from airl_mav.profiles.vehicle import CORNERS, COUNTER_CLOCKWISE, Corner, VehicleProfile
from firmware_sim.interfaces import FirmwareMissingError

_INT32, _REAL32 = 6, 9
"""MAV_PARAM_TYPE in QGroundControl's files."""


def qgroundcontrol_file(settings: Mapping[str, Value]) -> str:
    """Return a file for QGroundControl (Vehicle Setup > Parameters > Tools), format "Parameters".

    Lines contain vehicle id, component id, name, value and type, separated by tabs.
    """
    head = "# Vehicle-Id Component-Id Name Value Type\n"
    return head + "".join(
        f"1\t1\t{name}\t{value}\t{_INT32}\n"
        if isinstance(value, int)
        else f"1\t1\t{name}\t{value:.9g}\t{_REAL32}\n"
        for name, value in settings.items()
    )


_COLUMNS = 5
"""Number of columns, separated by tabs: vehicle id, component id, name, value, type."""


class KeptParameters:
    """Stored user parameters, by name. Implements `parameter_store.Keeper`."""

    def __init__(self, path: Path) -> None:
        """Set the file, which may not exist yet, in an existing folder."""
        self._path = path

    def read(self) -> dict[str, int | float]:
        """Return the stored parameters; {} without a file.

        Raises:
            UsageError: The file cannot be read, or is not a parameter file.
        """
        try:
            lines = self._path.read_text(encoding="utf-8").splitlines()
        except FileNotFoundError:
            return {}
        except (OSError, UnicodeDecodeError) as error:
            raise errors.UsageError(f"{self._path}: cannot be read: {error}") from None
        values: dict[str, int | float] = {}
        for number, line in enumerate(lines, start=1):
            if not line.strip() or line.startswith("#"):
                continue
            columns = line.split("\t")
            try:
                _, _, name, text, kind = columns
                values[name] = int(text) if int(kind) == _INT32 else float(text)
            except ValueError:
                raise errors.UsageError(
                    f"{self._path}: line {number}: accepted: {_COLUMNS} columns between tabs, "
                    f"vehicle, component, name, value, type; has {line!r}"
                ) from None
        return values

    def write(self, values: Mapping[str, int | float]) -> None:
        """Replace the stored parameters. Raises OSError if the file cannot be written."""
        files.replace_file(self._path, qgroundcontrol_file(values).encode())


Value = int | float


_FLOAT = struct.Struct("<f")


def same(held: Value, wanted: Value) -> bool:
    """Return True if a parameter has a value, to the precision of a 32-bit float."""
    if isinstance(held, int):
        return held == wanted
    (rounded,) = _FLOAT.unpack(_FLOAT.pack(wanted))
    return bool(abs(held - rounded) <= 1e-6 * max(1.0, abs(rounded)))


MOTORS = range(4)

SITL_OUTPUT, HITL_OUTPUT = "PWM_MAIN_FUNC{}", "HIL_ACT_FUNC{}"
"""PX4's parameter for the function of output {}."""

GROUND_LOSS = "NAV_DLL_ACT"
"""PX4's parameter for the action on ground station loss; 0 = disabled."""

_PX4_MOTOR_1 = 101
"""PX4's output function of motor 1 (docs: Actuator Configuration)."""

_PX4_MULTIROTOR = 0


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
        raise no_table("px4")
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
            f"{held['CA_ROTOR_COUNT']}: expected a multirotor (0) with 4 ({errors.PAGE})"
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


def refuse_untold(vehicle: VehicleProfile, firmware: str) -> None:
    """Raise FirmwareMissingError for a vehicle with sensors not supported by the firmware."""
    for name in ("vision", "rangefinder", "optical_flow"):
        if getattr(vehicle.sensors, name) is not None:
            raise FirmwareMissingError(
                f"--firmware {firmware}: the vehicle has sensors.{name}, which only builtin and px4"
                " are told of"
            )


def no_table(name: str) -> FirmwareMissingError:
    """Return the error for a vehicle profile without the table of a firmware."""
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
