"""Electrical power of the aircraft: momentum theory from the rotor's data, or a regression.

One kernel for plant and vectorized simulator. Both models give the aircraft's power with its flight
controller, but without the onboard computer.

The battery is a coulomb counter with an open-circuit voltage and an internal resistance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import AIR_DENSITY_KG_M3, C_PER_MAH, G_PER_KG, GRAVITY_M_S2
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from airl_mav.profiles.vehicle import CORNERS, VehicleProfile
from airl_mav.vehicle.airframe import Airframe, airframe_of
from airl_mav.vehicle.rotation import Quat, Vec

INDUCED_FACTOR = 1.15
"""Factor kappa of a real rotor's induced power over an ideal disc's (Leishman, Principles of
Helicopter Aerodynamics; quoted, not read)."""

PROFILE_RISE = 4.65
"""Increase of profile power with the advance ratio squared (4.6 to 4.7 after Leishman, quoted, not
read)."""

LEAST_THRUST_N = 1e-6
"""Thrust below which the rotors consume no power."""


class PowerModel(NamedTuple):
    """Constants of a vehicle's power model, all floats, so that an array row can store them."""

    momentum: float
    """1: momentum theory, 0: regression."""
    avionics_w: float
    """Power beside the rotors [W]; 0 for a regression, which includes it in its constant."""
    ideal2_per_thrust: float
    """1 / (2 rho A) of all rotors: v_h² by the thrust [m²/(s² N)]; this and the three below belong
    to momentum theory."""
    profile: float
    """1 / FM - kappa: profile power over ideal power in a hover."""
    advance: float
    """Ratio of T mu² to a rotor's maximum thrust times the squared in-plane velocity: the number of
    rotors over the squared tip speed at full command [s²/m²]."""
    drive: float
    """Electrical over shaft power: 1 / eta."""
    bandwidth_hz: float
    """Bandwidth of the accelerations; this and all below belong to the regression."""
    payload_g: float
    b1: float
    b2: float
    b3: float
    b4: float
    b5: float
    b6: float
    b7: float
    b8: float
    b9: float

    @classmethod
    def from_profile(cls, vehicle: VehicleProfile) -> PowerModel:
        """Collect the constants of a vehicle profile."""
        power = vehicle.power
        if power.model == "momentum":
            diameter_m = power.propeller_diameter_m
            area_m2 = len(CORNERS) * 0.25 * math.pi * diameter_m**2
            tip_m_s = vehicle.rotor.speed_max_rad_s * 0.5 * diameter_m
            rotors = (
                1.0,
                power.avionics_w,
                1.0 / (2.0 * AIR_DENSITY_KG_M3 * area_m2),
                1.0 / power.figure_of_merit - INDUCED_FACTOR,
                len(CORNERS) / tip_m_s**2,
                1.0 / power.drive_efficiency,
            )
            # The fields of the regression are unused.
            return cls(*rotors, *(0.0,) * (len(cls._fields) - len(rotors)))
        return cls(
            *(0.0,) * 6,
            power.bandwidth_hz,
            G_PER_KG * vehicle.body.payload_kg,
            power.b1_vxy,
            power.b2_axy,
            power.b3_vxy_axy,
            power.b4_vz,
            power.b5_az,
            power.b6_vz_az,
            power.b7_payload,
            power.b8_wind,
            power.b9_hover,
        )


@kernel
def power_model_of(row: Vector) -> PowerModel:
    """Return the model of a row (17,): kernels accept an array far faster than a tuple."""
    r = row
    return PowerModel(
        r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8],
        r[9], r[10], r[11], r[12], r[13], r[14], r[15], r[16],
    )  # fmt: skip


@kernel
def induced_velocity(ideal2: float, in_plane2: float, climb: float) -> float:
    """Return the induced velocity of the discs, v_i [m/s], by Glauert's equation.

    v_i = v_h² / sqrt(V_inplane² + (V_c + v_i)²). One step of Halley's method from the right side
    with the three velocities at right angles to each other. Exact in a hover, and to 4e-4 up to a
    climb of two and an advance of five times v_h, which leaves 2e-4 of the power.

    `ideal2` is v_h² = T / (2 rho A) > 0 of a hover, `in_plane2` the squared in-plane velocity
    against the air [m²/s²], `climb` the velocity V_c along the thrust, >= 0 [m/s].
    """
    v = ideal2 / math.sqrt(in_plane2 + climb * climb + ideal2)
    # Of f(v) = v sqrt(V_inplane² + (V_c + v)²) - v_h²: f, f' and f'', each times the root.
    through = climb + v
    whole2 = in_plane2 + through * through
    f = v * whole2 - ideal2 * math.sqrt(whole2)
    slope = whole2 + v * through
    bend = 2.0 * through * whole2 + v * in_plane2
    return v - 2.0 * f * slope * whole2 / (2.0 * slope * slope * whole2 - f * bend)


@kernel
def momentum_power_w(
    thrust: float, thrust_max: float, in_plane2: float, climb: float, m: PowerModel
) -> float:
    """Return the power by momentum theory [W].

    P = [kappa T v_i + P0 (1 + 4.65 mu²) + T max(V_c, 0)] / eta + P_avionics with P0 = (1/FM -
    kappa) T v_h. A hover therefore takes T^1.5 / sqrt(2 rho A) / FM / eta. T V_c includes the
    body's drag: a vehicle in level flight leans its thrust against it.

    A negative V_c counts as 0. Momentum theory does not hold from a hover down to twice the induced
    velocity, where the rotors fly in their wake. A descent measured on a 3DR Solo saved 10 %
    (discuss.ardupilot.org, thread 32200).

    `thrust` is T, of all rotors [N]. The speed of a rotor follows from its `thrust_max`.
    `in_plane2` and `climb`, V_c, are as in `induced_velocity`.
    """
    # Without thrust the discs have no induced velocity.
    if thrust < LEAST_THRUST_N:
        return m.avionics_w
    ideal2 = m.ideal2_per_thrust * thrust
    # The induced factor covers the losses of a real disc; the climb has none.
    up = max(0.0, climb)
    inflow = INDUCED_FACTOR * induced_velocity(ideal2, in_plane2, up) + up
    # T mu² by the rotors' mean square speed: thrust is proportional to the squared speed.
    advance = PROFILE_RISE * m.advance * thrust_max * in_plane2
    profile = m.profile * math.sqrt(ideal2) * (thrust + advance)
    return m.drive * (thrust * inflow + profile) + m.avionics_w


@kernel
def regression_power_w(velocity: Vec, acceleration: Vec, wind: Vec, m: PowerModel) -> float:
    """Return the power by the nine coefficients [W], never below 0.

    P = b1 |vxy| + b2 |axy| + b3 |vxy||axy| + b4 |vz| + b5 |az| + b6 |vz||az| + b7 m + b8 vxy.w + b9
    (Krishnan et al. 2021, eq. 1, after Tseng et al., arXiv 1703.10049). All vectors are NED; the
    acceleration is without gravity, low-passed by `felt`.
    """
    vxy = math.sqrt(velocity[0] * velocity[0] + velocity[1] * velocity[1])
    axy = math.sqrt(acceleration[0] * acceleration[0] + acceleration[1] * acceleration[1])
    vz = abs(velocity[2])
    az = abs(acceleration[2])
    # Positive with a tail wind.
    tail = velocity[0] * wind[0] + velocity[1] * wind[1]
    p = m.b1 * vxy + m.b2 * axy + m.b3 * vxy * axy + m.b4 * vz + m.b5 * az + m.b6 * vz * az
    return max(0.0, p + m.b7 * m.payload_g + m.b8 * tail + m.b9)


@kernel
def felt_share(m: PowerModel, dt: float) -> float:
    """Return the share of its last acceleration that a regression keeps over a tick of dt [s]."""
    if m.momentum != 0.0:
        return 0.0
    return math.exp(-2.0 * math.pi * m.bandwidth_hz * dt)


@kernel
def felt(before: Vec, velocity: Vec, newer: Vec, kept: float, dt: float, m: PowerModel) -> Vec:
    """Return the acceleration for a regression: a first-order low-pass, NED [m/s²].

    `before` is its value before the tick of dt [s], `velocity` and `newer` are the velocities
    before and after it, `kept` is `felt_share`. Momentum theory needs no acceleration and returns
    `before`.
    """
    if m.momentum != 0.0:
        return before
    share = (1.0 - kept) / dt
    return (
        kept * before[0] + share * (newer[0] - velocity[0]),
        kept * before[1] + share * (newer[1] - velocity[1]),
        kept * before[2] + share * (newer[2] - velocity[2]),
    )


@kernel
def flight_power_w(
    thrust: float,
    velocity: Vec,
    q: Quat,
    wind: Vec,
    acceleration: Vec,
    airframe: Airframe,
    m: PowerModel,
) -> float:
    """Return the power over a tick of flight [W], without the onboard computer.

    Velocity, attitude (body -> NED) and acceleration (by `felt`) apply at the start of the tick, in
    which its forces act; `thrust` is the sum of all rotors [N].
    """
    if m.momentum == 0.0:
        return regression_power_w(velocity, acceleration, wind, m)
    x, y, z = velocity[0] - wind[0], velocity[1] - wind[1], velocity[2] - wind[2]
    # Along the thrust, the third column of the rotation with its sign changed.
    climb = -(
        2.0 * (q[1] * q[3] + q[0] * q[2]) * x
        + 2.0 * (q[2] * q[3] - q[0] * q[1]) * y
        + (1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2])) * z
    )
    # Rounding may make the difference negative.
    in_plane2 = max(0.0, x * x + y * y + z * z - climb * climb)
    return momentum_power_w(thrust, airframe.thrust_max, in_plane2, climb, m)


@kernel
def standing_power_w(thrust: float, airframe: Airframe, m: PowerModel) -> float:
    """Return the power of a vehicle in contact [W], for its thrust at rest.

    A regression only models flight, and an impact is no electrical load. Its hover is scaled by
    T^1.5, as in momentum theory.
    """
    if m.momentum != 0.0:
        return momentum_power_w(thrust, airframe.thrust_max, 0.0, 0.0, m)
    share = thrust / (airframe.mass * GRAVITY_M_S2)
    return (m.b9 + m.b7 * m.payload_g) * share * math.sqrt(share)


@kernel
def level_power_w(speed: float, airframe: Airframe, m: PowerModel) -> float:
    """Return the power of steady level flight in calm air at a speed [m/s]; 0: of a hover [W]."""
    if m.momentum == 0.0:
        still = (0.0, 0.0, 0.0)
        return regression_power_w((speed, 0.0, 0.0), still, still, m)
    weight = airframe.mass * GRAVITY_M_S2
    # Equilibrium: the thrust carries the weight and balances the drag.
    drag = (airframe.drag_linear + airframe.drag_quadratic * speed) * speed
    thrust = math.sqrt(weight * weight + drag * drag)
    # Components of the speed along and across the thrust.
    climb = speed * drag / thrust
    in_plane = speed * weight / thrust
    return momentum_power_w(thrust, airframe.thrust_max, in_plane * in_plane, climb, m)


@kernel
def terminal_voltage(open_circuit_v: float, resistance_ohm: float, power: float) -> float:
    """Return the voltage under a constant-power load [W]: V = E - R P / V, upper root.

    Above the pack's maximum power, E²/4R, returns the voltage at that power: E/2.
    """
    discriminant = open_circuit_v * open_circuit_v - 4.0 * resistance_ohm * power
    return 0.5 * (open_circuit_v + math.sqrt(max(0.0, discriminant)))


@kernel
def open_circuit(remaining: float, empty_v: float, full_v: float) -> float:
    """Return the open-circuit voltage, linear in the state of charge 0..1."""
    return empty_v + (full_v - empty_v) * remaining


@kernel
def drain(remaining: float, current_a: float, capacity_mah: float, dt: float) -> float:
    """Return the state of charge after dt [s] at a current [A], not below 0."""
    return max(0.0, remaining - current_a * (dt / (capacity_mah * C_PER_MAH)))


def level_powers_w(vehicle: VehicleProfile, speeds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the powers (n,) of steady level flight in calm air at speeds (n,) [m/s]; 0: hover."""
    airframe = np.array(Airframe.from_profile(vehicle))
    return _level_powers(speeds, airframe, np.array(PowerModel.from_profile(vehicle)))


@kernel
def _level_powers(speeds: Vector, airframe: Vector, model: Vector) -> NDArray[np.float64]:
    a, m = airframe_of(airframe), power_model_of(model)
    powers = np.empty(len(speeds))
    for i in range(len(speeds)):
        powers[i] = level_power_w(speeds[i], a, m)
    return powers
