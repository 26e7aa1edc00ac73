"""Flight conditions: wind, payload, domain randomization and sensor noise.

The tables are used by scenarios and training environments.
"""

from __future__ import annotations

from typing import ClassVar

from airl_mav.core.constants import G_PER_KG, GRAVITY_M_S2
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import ProfileModel, quantity, validated
from airl_mav.profiles.computer import ComputerProfile, load_computer
from airl_mav.profiles.vehicle import CORNERS, VehicleProfile, load_vehicle


class WindSettings(ProfileModel):
    """Steady wind and gusts; calm by default."""

    north_m_s: float = quantity("steady wind towards north", "m/s", ge=-50, le=50, default=0.0)
    east_m_s: float = quantity("steady wind towards east", "m/s", ge=-50, le=50, default=0.0)
    random_m_s: float = quantity(
        "steady wind on top, of any direction and of a speed from 0 to this, drawn with every"
        " episode",
        "m/s",
        ge=0,
        le=50,
        default=0.0,
    )
    gust_m_s: float = quantity(
        "standard deviation of the gusts on each horizontal axis; half of it on the vertical",
        "m/s",
        ge=0,
        le=50,
        default=0.0,
    )
    gust_time_s: float = quantity(
        "correlation time of the gusts", "s", ge=0.01, le=1000, default=2.0
    )


class Payload(ProfileModel):
    """A point mass relative to the middle of the rotors; none by default."""

    mass_g: float = quantity("mass of the payload", "g", ge=0, le=100_000, default=0.0)
    forward_m: float = quantity("ahead of the middle", "m", ge=-2, le=2, default=0.0)
    right_m: float = quantity("to the right of the middle", "m", ge=-2, le=2, default=0.0)
    down_m: float = quantity("below the middle", "m", ge=-2, le=2, default=0.0)


class Spread(ProfileModel):
    """Domain randomization of the aircraft, drawn for every episode; 0 = as in the profile.

    The flight controller still assumes the profile's values.
    """

    GROUP: ClassVar[str] = "domain randomization"
    mass: float = quantity("mass and inertia, +- this share", "1", ge=0, le=0.9, default=0.0)
    thrust: float = quantity("greatest thrust, +- this share", "1", ge=0, le=0.9, default=0.0)
    drag: float = quantity("drag, +- this share", "1", ge=0, le=0.9, default=0.0)
    rotor_lag: float = quantity(
        "rotor time constant, +- this share", "1", ge=0, le=0.9, default=0.0
    )


class SensorNoise(ProfileModel):
    """Scale of sensor noise relative to the profile."""

    GROUP: ClassVar[str] = "sensors"
    navigation_noise: float = quantity(
        "noise, bias and drift of IMU, GPS, barometer and magnetometer, times this; where the"
        " estimator is a model of its error, that error. The estimator keeps its nominal settings",
        "1",
        ge=0,
        le=10,
        default=1.0,
    )
    depth_noise: float = quantity(
        "sd of the depth noise at 10 m, as a share; grows with the square of the depth as of a"
        " stereo camera",
        "1",
        ge=0,
        le=0.9,
        default=0.0,
    )
    stereo_noise: float = quantity(
        "disparity noise of a stereo camera (table `camera.stereo` of the vehicle's profile), times"
        " this; 0: an ideal camera, without its holes and steps, too",
        "1",
        ge=0,
        le=10,
        default=1.0,
    )
    depth_dropout: float = quantity(
        "share of pixels without a return, drawn anew each frame", "1", ge=0, le=0.9, default=0.0
    )


def loaded(
    vehicle: VehicleProfile, computer: ComputerProfile | None, payload: Payload
) -> VehicleProfile:
    """Return a vehicle with its load; without a load, the vehicle itself.

    Computer and payload are point masses. The computer is in the middle of the rotors. Ground
    equipment adds no mass. Mass, centre of mass and inertia about it follow (parallel axes).
    Collision body, drag and camera keep their position relative to the centre of mass. Products of
    inertia and the height of the centre of mass below the rotors are ignored: no modelled force
    depends on the height. Raises FieldError if the rotors do not carry the mass with a margin, or
    the offset of the centre of mass.
    """
    board_kg = 0.0 if computer is None else computer.onboard_mass_kg
    load_kg = payload.mass_g / G_PER_KG
    if board_kg + load_kg == 0.0:
        return vehicle
    body = vehicle.body
    mass_kg = body.mass_kg + board_kg + load_kg
    if (problem := vehicle.too_heavy(mass_kg)) is not None:
        if load_kg:
            raise FieldError("payload.mass_g", payload.mass_g, problem=problem)
        raise FieldError("computer", f"{G_PER_KG * board_kg:g} g", problem=problem)
    # Mass [kg] and position: forward, right, down of the middle of the rotors [m].
    points = (
        (body.mass_kg, body.com_forward_m, body.com_right_m, 0.0),
        (board_kg, 0.0, 0.0, 0.0),
        (load_kg, payload.forward_m, payload.right_m, payload.down_m),
    )
    forward_m, right_m, down_m = (
        sum(point[0] * point[axis] for point in points) / mass_kg for axis in (1, 2, 3)
    )
    _check_balance(vehicle, payload, mass_kg, forward_m, right_m)
    xx, yy, zz = body.inertia_xx_kg_m2, body.inertia_yy_kg_m2, body.inertia_zz_kg_m2
    for mass, forward, right, down in points:
        f2, r2, d2 = (forward - forward_m) ** 2, (right - right_m) ** 2, (down - down_m) ** 2
        xx += mass * (r2 + d2)
        yy += mass * (f2 + d2)
        zz += mass * (f2 + r2)
    carrying = {
        "mass_kg": mass_kg,
        "inertia_xx_kg_m2": xx,
        "inertia_yy_kg_m2": yy,
        "inertia_zz_kg_m2": zz,
        "com_forward_m": forward_m,
        "com_right_m": right_m,
        "payload_kg": body.payload_kg + board_kg + load_kg,
    }
    return validated(
        VehicleProfile, {**vehicle.model_dump(), "body": {**body.model_dump(), **carrying}}
    )


def equipped(
    vehicle: str, computer: str, payload: Payload
) -> tuple[VehicleProfile, ComputerProfile]:
    """Return a vehicle, `loaded`, and its computer, by names or paths. Raises UsageError."""
    board = load_computer(computer)
    return loaded(load_vehicle(vehicle), board, payload), board


def check_spread(vehicle: VehicleProfile, spread: Spread, table: str = "spread") -> None:
    """Raise FieldError, naming the table, if the worst case of a spread cannot hover."""
    heaviest_kg = vehicle.body.mass_kg * (1.0 + spread.mass)
    if (problem := vehicle.too_heavy(heaviest_kg, 1.0 - spread.thrust)) is not None:
        name = "mass" if spread.mass > spread.thrust else "thrust"
        problem = f"at the ends of mass and thrust {problem}"
        raise FieldError(f"{table}.{name}", getattr(spread, name), problem=problem)


def _check_balance(
    vehicle: VehicleProfile, payload: Payload, mass_kg: float, forward_m: float, right_m: float
) -> None:
    """Raise FieldError if the rotors cannot hover around a centre of mass.

    Without torque a rotor carries a quarter of the weight, plus or minus the displacement of the
    centre of mass towards the rotor, in shares of the arms.
    """
    rotor = vehicle.rotor
    ahead, aside = forward_m / rotor.arm_forward_m, right_m / rotor.arm_right_m
    lean, quarter_n = abs(ahead) + abs(aside), mass_kg * GRAVITY_M_S2 / len(CORNERS)
    least_n, most_n = quarter_n * (1.0 - lean), quarter_n * (1.0 + lean)
    if least_n >= 0.0 and most_n <= rotor.thrust_max_n:
        return
    name = "forward_m" if abs(ahead) >= abs(aside) else "right_m"
    raise FieldError(
        f"payload.{name}",
        getattr(payload, name),
        problem=f"cannot hover: the rotors would have to give {least_n:.2f} to {most_n:.2f} newton "
        f"each, they have 0 to {rotor.thrust_max_n:g}",
    )
