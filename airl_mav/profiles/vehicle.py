"""Vehicle profile and flight conditions.

The profile: airframe, rotors, drag, battery, power model, sensors, parameters. The conditions:
wind, payload, domain randomization and sensor noise, for scenarios and training environments.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, Strict, model_validator
from typing_extensions import Self

from airl_mav.core.constants import C_PER_MAH, G_PER_KG, GRAVITY_M_S2
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.fields import ProfileModel, later_field, optional, quantity, validated
from airl_mav.core.frames import HOME, Geodetic
from airl_mav.profiles.camera import Camera, FurtherCameras, check_rates, with_the_rate
from airl_mav.profiles.computer import ComputerProfile, load_computer
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.px4_release import CURRENT, PX4ReleaseName, px4_release


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
    vehicle: str, computer: str, payload: Payload, release: PX4ReleaseName | None = None
) -> tuple[VehicleProfile, ComputerProfile]:
    """Return a vehicle, `loaded`, and its computer, by names or paths. Raises UsageError.

    `release` replaces the vehicle's PX4 release; None = as in its profile.
    """
    board = load_computer(computer)
    return loaded(load_vehicle(vehicle, release), board, payload), board


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


class Imu(ProfileModel):
    """Accelerometer and gyroscope: white noise, bias at start, bias random walk."""

    accel_noise_m_s2: float = quantity("white noise, sd of a sample", "m/s²", ge=0, le=10)
    accel_bias_m_s2: float = quantity("start bias, sd", "m/s²", ge=0, le=2)
    accel_walk_m_s2_sqrt_s: float = quantity("bias random walk", "m/s²/sqrt(s)", ge=0, le=0.1)
    gyro_noise_rad_s: float = quantity("white noise, sd of a sample", "rad/s", ge=0, le=1)
    gyro_bias_rad_s: float = quantity("start bias, sd", "rad/s", ge=0, le=0.2)
    gyro_walk_rad_s_sqrt_s: float = quantity("bias random walk", "rad/s/sqrt(s)", ge=0, le=0.01)


class Magnetometer(ProfileModel):
    """Three-axis magnetometer, calibrated."""

    rate_hz: float = quantity("sample rate", "Hz", ge=1, le=250)
    noise_gauss: float = quantity("white noise, sd of a sample", "gauss", ge=0, le=0.1)


class Barometer(ProfileModel):
    """Static pressure sensor."""

    rate_hz: float = quantity("sample rate", "Hz", ge=1, le=250)
    noise_pa: float = quantity("white noise, sd of a sample", "Pa", ge=0, le=100)
    drift_pa_sqrt_s: float = quantity("drift random walk", "Pa/sqrt(s)", ge=0, le=10)


class Gps(ProfileModel):
    """GPS receiver."""

    fitted: bool = Field(default=True, description="whether the vehicle has one")
    rate_hz: float = quantity("fixes a second", "Hz", ge=1, le=25)
    horizontal_noise_m: float = quantity("white noise, sd", "m", ge=0, le=10)
    vertical_noise_m: float = quantity("white noise, sd", "m", ge=0, le=20)
    velocity_noise_m_s: float = quantity("white noise, sd per axis", "m/s", ge=0, le=2)
    drift_m_sqrt_s: float = quantity("position drift random walk", "m/sqrt(s)", ge=0, le=1)
    drift_time_constant_s: float = quantity("the drift decays with", "s", gt=1, le=10_000)


class Vision(ProfileModel):
    """Visual-inertial odometry, or a motion capture system: the pose in a local frame.

    The frame is the vehicle's at the start. Drift accumulates with distance and with time. There is
    no loop closure.
    """

    rate_hz: float = quantity("poses a second", "Hz", ge=5, le=250)
    delay_s: float = quantity("from a pose until it is told", "s", ge=0, le=0.3)
    position_noise_m: float = quantity("white noise, sd per axis", "m", ge=0, le=1)
    velocity_noise_m_s: float = quantity("white noise, sd per axis", "m/s", ge=0, le=2)
    angle_noise_rad: float = quantity("white noise, sd per axis", "rad", ge=0, le=0.5)
    position_drift_m_sqrt_m: float = quantity(
        "position drift random walk, by the way flown, sd per axis", "m/sqrt(m)", ge=0, le=1
    )
    yaw_drift_rad_sqrt_s: float = quantity("heading drift random walk", "rad/sqrt(s)", ge=0, le=0.1)


class Rangefinder(ProfileModel):
    """A distance sensor that looks straight down in body axes: one ray.

    Ranges outside the limits, and missing returns, are reported as invalid (a quality of 0).
    """

    rate_hz: float = quantity("ranges a second", "Hz", ge=1, le=100)
    least_m: float = quantity("least range that it measures", "m", ge=0, le=5)
    greatest_m: float = quantity("greatest range that it measures", "m", gt=0.1, le=300)
    noise_m: float = quantity("white noise, sd", "m", ge=0, le=1)
    forward_m: float = quantity("its place ahead of the centre", "m", default=0.0, ge=-2, le=2)
    right_m: float = quantity("its place to the right of the centre", "m", default=0.0, ge=-2, le=2)
    down_m: float = quantity("its place below the centre", "m", default=0.0, ge=-2, le=2)

    @model_validator(mode="after")
    def _measures(self) -> Self:
        if self.greatest_m <= self.least_m:
            raise ValueError(
                f"greatest_m = {self.greatest_m:g}: accepted: more than least_m = {self.least_m:g}"
            )
        return self


class OpticalFlow(ProfileModel):
    """A camera that looks straight down in body axes and reports the optical flow of the ground.

    Outside its limits, and without ground below, it reports a quality of 0. It has no gyro: the
    flight controller uses its own gyro.
    """

    rate_hz: float = quantity("measurements a second", "Hz", ge=5, le=125)
    least_m: float = quantity("least distance of the ground that it sees sharply", "m", ge=0, le=5)
    greatest_m: float = quantity("greatest distance at which it sees texture", "m", gt=0.1, le=300)
    greatest_rad_s: float = quantity("fastest flow that it measures", "rad/s", ge=0.1, le=100)
    noise_rad_s: float = quantity("white noise of each axis, sd", "rad/s", ge=0, le=10)
    forward_m: float = quantity("its place ahead of the centre", "m", default=0.0, ge=-2, le=2)
    right_m: float = quantity("its place to the right of the centre", "m", default=0.0, ge=-2, le=2)
    down_m: float = quantity("its place below the centre", "m", default=0.0, ge=-2, le=2)

    @model_validator(mode="after")
    def _sees(self) -> Self:
        if self.greatest_m <= self.least_m:
            raise ValueError(
                f"greatest_m = {self.greatest_m:g}: accepted: more than least_m = {self.least_m:g}"
            )
        return self


class Sensors(ProfileModel):
    """The sensor suite."""

    imu: Imu
    magnetometer: Magnetometer
    barometer: Barometer
    gps: Gps
    vision: Vision | None = optional(
        "what tells the flight controller its pose; absent = nothing does"
    )
    rangefinder: Rangefinder | None = optional(
        "what measures how far the ground is; absent = nothing does"
    )
    optical_flow: OpticalFlow | None = later_field(
        None, "what measures how the ground moves below; absent = nothing does"
    )


class BodyProfile(ProfileModel):
    """The rigid body."""

    mass_kg: float = quantity("take-off mass", "kg", gt=0.05, le=100)
    inertia_xx_kg_m2: float = quantity("inertia about the forward axis", "kg m²", gt=1e-6, le=100)
    inertia_yy_kg_m2: float = quantity("inertia about the right axis", "kg m²", gt=1e-6, le=100)
    inertia_zz_kg_m2: float = quantity("inertia about the down axis", "kg m²", gt=1e-6, le=100)
    width_m: float = quantity("width across the propellers, for clearances", "m", gt=0.02, le=10)
    height_m: float = quantity("height of the collision body", "m", gt=0.01, le=5)
    com_forward_m: float = quantity(
        "centre of mass ahead of the middle of the rotors", "m", ge=-5, le=5, default=0.0
    )
    com_right_m: float = quantity(
        "centre of mass to the right of the middle of the rotors", "m", ge=-5, le=5, default=0.0
    )
    payload_kg: float = quantity(
        "how much of the take-off mass is carried: what a regression's payload term counts",
        "kg",
        ge=0,
        le=100,
        default=0.0,
    )


THRUST_MARGIN = 0.3
"""Minimum thrust margin as a share of the weight; a smaller margin leaves no control authority."""

Corner = Literal["front right", "rear left", "front left", "rear right"]
"""Position of a motor. Front right and rear left turn counter-clockwise seen from above."""

CORNERS: tuple[Corner, ...] = ("front right", "rear left", "front left", "rear right")
"""Order of motors in this project, the same as PX4's for a quad X."""

COUNTER_CLOCKWISE: tuple[Corner, ...] = ("front right", "rear left")
"""Motors with a rotor that turns counter-clockwise, seen from above."""


class Rotor(ProfileModel):
    """Four equal rotors in PX4 quad-X order: front right, rear left, front left, rear right.

    Front right and rear left turn counter-clockwise seen from above (PX4's CA_ROTORn_KM > 0).
    """

    arm_forward_m: float = quantity(
        "distance of the rotors fore and aft of the centre", "m", gt=0.01, le=5
    )
    arm_right_m: float = quantity(
        "distance of the rotors right and left of the centre", "m", gt=0.01, le=5
    )
    thrust_max_n: float = quantity("static thrust at full command", "N", gt=0.01, le=1000)
    torque_per_thrust_m: float = quantity("drag torque per newton of thrust", "m", gt=0, le=1)
    time_constant_s: float = quantity("first-order lag of the rotor speed", "s", gt=0, le=1)
    thrust_curve: float = quantity(
        "thrust = max (c u² + (1 - c) u) of command u: 0 linear, 1 quadratic (PX4's THR_MDL_FAC)",
        "1",
        ge=0,
        le=1,
    )
    speed_max_rad_s: float = quantity("rotor speed at full command", "rad/s", gt=10, le=20000)

    def px4_geometry(self) -> dict[str, float]:
        """Return rotor positions and directions as PX4's parameters CA_ROTORn_*."""
        values = {}
        for i, corner in enumerate(CORNERS):
            forward = 1.0 if corner.startswith("front") else -1.0
            right = 1.0 if corner.endswith("right") else -1.0
            turn = 1.0 if corner in COUNTER_CLOCKWISE else -1.0
            values[f"CA_ROTOR{i}_PX"] = self.arm_forward_m * forward
            values[f"CA_ROTOR{i}_PY"] = self.arm_right_m * right
            values[f"CA_ROTOR{i}_KM"] = self.torque_per_thrust_m * turn
        return values


class Drag(ProfileModel):
    """Aerodynamic drag of the body relative to the air: F = -(linear v + quadratic |v| v)."""

    linear_n_s_m: float = quantity("linear (rotor) drag", "N/(m/s)", ge=0, le=10)
    quadratic_n_s2_m2: float = quantity("quadratic (body) drag", "N/(m/s)²", ge=0, le=10)
    angular_n_m_s: float = quantity("rotational damping", "N m/(rad/s)", ge=0, le=1)


class Battery(ProfileModel):
    """A LiPo pack: open-circuit voltage linear in the charge, internal resistance."""

    cells: int = quantity("cells in series", "1", ge=1, le=24)
    capacity_mah: float = quantity("capacity", "mAh", gt=10, le=1_000_000)
    cell_full_v: float = quantity("open-circuit voltage of a full cell", "V", gt=3, le=4.5)
    cell_empty_v: float = quantity("open-circuit voltage of an empty cell", "V", gt=2.5, le=4)
    resistance_ohm: float = quantity("internal resistance of the pack", "ohm", ge=0, le=1)

    def energy_j(self, charge: float) -> float:
        """Return the energy of a pack at a state of charge 0..1 [J].

        Charge times the mean open-circuit voltage until empty. The internal resistance dissipates a
        part: the current times the resistance over the voltage, 1 to 2 % for a quad in hover.
        """
        mean_v = self.cell_empty_v + 0.5 * charge * (self.cell_full_v - self.cell_empty_v)
        return charge * self.capacity_mah * C_PER_MAH * self.cells * mean_v


class Momentum(ProfileModel):
    """Power by momentum theory, from rotor data; formula in docs/explanation/energy.md."""

    model: Literal["momentum"] = Field(description="momentum theory")
    propeller_diameter_m: float = quantity("diameter of a propeller", "m", gt=0.01, le=5)
    figure_of_merit: float = quantity(
        "ideal over shaft power in a hover: 0.35 below 60 mm, 0.48 at 5 inch, 0.65 at 10 inch",
        "1",
        ge=0.2,
        le=0.85,
    )
    drive_efficiency: float = quantity(
        "shaft over electrical power: motor and ESC", "1", ge=0.1, le=1
    )
    avionics_w: float = quantity(
        "flight controller, sensors and radio, without the onboard computer", "W", ge=0, le=1000
    )


class Regression(ProfileModel):
    """Nine-coefficient power model of the paper (eq. 1; Tseng et al., arXiv 1703.10049), SI units.

    P = b1 |vxy| + b2 |axy| + b3 |vxy||axy| + b4 |vz| + b5 |az| + b6 |vz||az| + b7 m + b8 vxy.w + b9

    The model is valid for the fitted aircraft only: it is independent of mass and rotors. The
    bandwidth of the accelerations that Tseng et al. fitted is not published.
    """

    model: Literal["regression"] = Field(description="nine coefficients")
    bandwidth_hz: float = quantity(
        "first-order low-pass of the accelerations; assumed", "Hz", gt=0, le=100, default=1.0
    )
    b1_vxy: float = quantity("horizontal speed", "W/(m/s)", ge=-1000, le=1000)
    b2_axy: float = quantity("horizontal acceleration", "W/(m/s²)", ge=-1000, le=1000)
    b3_vxy_axy: float = quantity("product of the two", "W/(m²/s³)", ge=-1000, le=1000)
    b4_vz: float = quantity("vertical speed", "W/(m/s)", ge=-1000, le=1000)
    b5_az: float = quantity("vertical acceleration", "W/(m/s²)", ge=-1000, le=1000)
    b6_vz_az: float = quantity("product of the two", "W/(m²/s³)", ge=-1000, le=1000)
    b7_payload: float = quantity("payload", "W/g", ge=-100, le=100)
    b8_wind: float = quantity("ground velocity . wind", "W/(m²/s²)", ge=-1000, le=1000)
    b9_hover: float = quantity("hover", "W", ge=0, le=100_000)


class Estimation(ProfileModel):
    """Estimation error of the flight controller in flight, as modelled by environments.

    Each axis is a first-order Gauss-Markov process: standard deviation and correlation time. Fitted
    by `scripts/fit-estimation-error`, which prints this table.
    """

    position_horizontal_m: float = quantity("sd of north and east", "m", ge=0, le=100)
    position_horizontal_time_s: float = quantity("its correlation time", "s", gt=0, le=100_000)
    position_vertical_m: float = quantity("sd of down", "m", ge=0, le=100)
    position_vertical_time_s: float = quantity("its correlation time", "s", gt=0, le=100_000)
    velocity_horizontal_m_s: float = quantity("sd of north and east", "m/s", ge=0, le=10)
    velocity_horizontal_time_s: float = quantity("its correlation time", "s", gt=0, le=100_000)
    velocity_vertical_m_s: float = quantity("sd of down", "m/s", ge=0, le=10)
    velocity_vertical_time_s: float = quantity("its correlation time", "s", gt=0, le=100_000)
    tilt_rad: float = quantity("sd of the turn about north and about east", "rad", ge=0, le=1)
    tilt_time_s: float = quantity("its correlation time", "s", gt=0, le=100_000)
    heading_rad: float = quantity("sd of the turn about down", "rad", ge=0, le=1)
    heading_time_s: float = quantity("its correlation time", "s", gt=0, le=100_000)


class Response(ProfileModel):
    """First-order model of the vehicle's response to velocity setpoints.

    Identified from flown steps by `scripts/fit-response`, which prints this table. Latency
    compensation uses it to predict the vehicle's motion.
    """

    dead_time_s: float = quantity(
        "setpoint accepted until the velocity begins to answer", "s", ge=0, le=2
    )
    velocity_time_s: float = quantity("time constant of the velocity", "s", gt=0, le=10)
    yaw_rate_dead_time_s: float = quantity("dead time of the yaw rate", "s", ge=0, le=2)
    yaw_rate_time_s: float = quantity("time constant of the yaw rate", "s", gt=0, le=10)
    drag_1_s: float = quantity(
        "deceleration that it leans against, per speed", "1/s", ge=0, le=5, default=0.0
    )


# Strict, or true and "0.5" would pass; an integer passes for a float.
ParameterTable = dict[str, Annotated[float, Strict()]]


# Integers stay integers: real firmware has parameters of both types.
TypedParameterTable = dict[str, Annotated[int, Strict()] | Annotated[float, Strict()]]


class FirmwareRequirements(ProfileModel):
    """Settings required in real firmware to fly this vehicle."""

    motors: tuple[Corner, Corner, Corner, Corner] = Field(
        description="which motor hangs on each of the firmware's outputs 1 to 4"
    )
    parameters: TypedParameterTable = Field(
        default_factory=dict, description="set where we start the firmware, checked where not"
    )

    @model_validator(mode="after")
    def _every_corner_once(self) -> FirmwareRequirements:
        if len(set(self.motors)) != len(CORNERS):
            corners = ", ".join(CORNERS)
            raise ValueError(f"motors = {list(self.motors)}: accepted: each once of {corners}")
        return self


class Px4(FirmwareRequirements):
    """Settings for PX4; rotor geometry and thrust curve follow from the vehicle."""

    airframe: int = quantity("SYS_AUTOSTART, airframe of PX4's simulator", "1", ge=1, le=99_999)


class ArduPilot(FirmwareRequirements):
    """Settings for ArduCopter."""

    frame_class: int = quantity("FRAME_CLASS, 1 = quad", "1", ge=1, le=1)
    frame_type: int = quantity("FRAME_TYPE, 1 = X", "1", ge=0, le=20)


class VehicleProfile(ProfileModel):
    """Complete description of the aircraft except the companion computer."""

    description: str = Field(description="one line for people")
    source: str = Field(description="where the numbers come from")
    body: BodyProfile
    rotor: Rotor
    drag: Drag
    battery: Battery
    power: Momentum | Regression = Field(discriminator="model", description="power model")
    camera: Camera
    cameras: FurtherCameras = later_field(
        dict,
        "further cameras by name, each a table as `camera`, triggered with that one:"
        " their rate_hz is left out",
    )
    sensors: Sensors
    estimation: Estimation | None = optional(
        "error of the estimator on these sensors; absent = not known"
    )
    response: Response | None = optional(
        "how it answers velocity setpoints; absent = not known: its decisions' latency"
        " cannot be compensated"
    )
    px4_release: PX4ReleaseName = Field(
        default=CURRENT, description="PX4 release that the built-in autopilot emulates"
    )
    parameters: ParameterTable = Field(
        default_factory=dict,
        description="PX4-named parameters of the built-in autopilot that differ from the defaults",
    )
    px4: Px4 | None = optional("for --firmware px4 and px4-hitl")
    ardupilot: ArduPilot | None = optional("for --firmware ardupilot")

    @model_validator(mode="before")
    @classmethod
    def _triggered_together(cls, data: Any) -> Any:
        return with_the_rate(data)

    @model_validator(mode="after")
    def _one_rate(self) -> VehicleProfile:
        check_rates(self.camera, self.cameras)
        return self

    @model_validator(mode="after")
    def _hovers(self) -> VehicleProfile:
        if (problem := self.too_heavy(self.body.mass_kg)) is not None:
            raise FieldError("body.mass_kg", self.body.mass_kg, problem=problem)
        return self

    def too_heavy(self, mass_kg: float, thrust_share: float = 1.0) -> str | None:
        """Return why rotors at a share of thrust cannot carry a mass with a margin, or None."""
        needed_n = (1.0 + THRUST_MARGIN) * mass_kg * GRAVITY_M_S2
        thrust_n = thrust_share * self.thrust_n
        if thrust_n >= needed_n:
            return None
        return (
            f"cannot hover: needs {needed_n:.2f} newton with {100 * THRUST_MARGIN:g} % margin, has "
            f"{thrust_n:.2f} ({len(CORNERS)} x rotor.thrust_max_n "
            f"{thrust_share * self.rotor.thrust_max_n:g})"
        )

    @property
    def compensable(self) -> bool:
        """True if latency compensation is supported: known response and a depth camera."""
        return self.response is not None and self.camera.kind == "depth"

    @property
    def uses_gps(self) -> bool:
        """True if the flight controller gets its global position from GPS."""
        return self.sensors.gps.fitted and self.parameters.get("EKF2_GPS_CTRL", 1) != 0

    @property
    def told_origin(self) -> Geodetic | None:
        """Global origin that a rehearsal sets for a vehicle without GPS; None = GPS provides it."""
        return None if self.uses_gps else HOME

    @property
    def thrust_n(self) -> float:
        """Maximum thrust of all rotors [N]; at least `THRUST_MARGIN` above the weight."""
        return len(CORNERS) * self.rotor.thrust_max_n

    def autopilot_parameters(self) -> dict[str, float]:
        """Return the built-in autopilot's parameters: its rotor positions, and `parameters`."""
        known = px4_release(self.px4_release).spec_by_name
        places = {n: v for n, v in self.rotor.px4_geometry().items() if n in known}
        return {**places, **self.parameters}

    def flown_parameters(self) -> dict[str, float]:
        """Return all values in flight of the built-in autopilot's parameters."""
        return px4_release(self.px4_release).flown_values(self.autopilot_parameters())


def load_vehicle(name: str, release: PX4ReleaseName | None = None) -> VehicleProfile:
    """Return a vehicle profile by name or path, with another PX4 release. Raises UsageError."""
    vehicle = load_profile("vehicles", name, VehicleProfile)
    if release is not None:
        vehicle = vehicle.model_copy(update={"px4_release": release})
    try:
        px4_release(vehicle.px4_release).parameter_values(vehicle.parameters)
    except UsageError as error:
        raise UsageError(f"vehicle {name}: {error}") from None
    return vehicle
