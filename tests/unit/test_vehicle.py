"""Rotors, rigid body, battery against closed forms, numpy, scipy's integrator, pybullet."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pybullet
import pybullet_utils.bullet_client as bullet_client
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from airl_mav.core.constants import GRAVITY_M_S2, TICK_S
from airl_mav.core.frames import ned_to_enu, quat_ned_frd_to_enu_flu, quat_wxyz_to_xyzw
from airl_mav.core.kernels import kernel
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.vehicle.airframe import (
    Airframe,
    airframe_of,
    drag_force,
    hover_speeds,
    lag,
    settle,
    steady_speed,
    step,
    wrench,
)
from airl_mav.vehicle.power import drain, open_circuit, terminal_voltage
from airl_mav.vehicle.rotation import Quat, Vec

QUAD = Airframe.from_profile(load_profile("vehicles", "quad", VehicleProfile))
LEVEL = (1.0, 0.0, 0.0, 0.0)
ZERO = (0.0, 0.0, 0.0)

# PX4's quad X, from its documentation: front right, rear left (both counter-clockwise seen from
# above), front left, rear right (clockwise). Positions FRD.
POSITIONS = np.array([[1, 1, 0], [-1, -1, 0], [1, -1, 0], [-1, 1, 0]]) * [
    QUAD.arm_forward,
    QUAD.arm_right,
    0.0,
]
CLOCKWISE = np.array([-1.0, -1.0, 1.0, 1.0])


# --- rotors


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.integers(1, 200))
def test_lag_is_an_exact_exponential(curve: float, start: float, command: float, n: int) -> None:
    airframe = QUAD._replace(thrust_curve=curve)
    target = steady_speed(command, curve)
    speed = start
    for _ in range(n):
        speed = settle(speed, command, airframe, lag(airframe, TICK_S))
    exact = target + (start - target) * math.exp(-n * TICK_S / QUAD.rotor_time_constant)
    assert speed == pytest.approx(exact, abs=1e-12)


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_steady_thrust_follows_the_curve(command: float, curve: float) -> None:
    share = curve * command**2 + (1 - curve) * command
    assert steady_speed(command, curve) ** 2 == pytest.approx(share, abs=1e-12)


@pytest.mark.parametrize(("command", "speed"), [(-0.5, 0.0), (1.5, 1.0)])
def test_commands_beyond_the_range_are_clipped(command: float, speed: float) -> None:
    assert steady_speed(command, 0.3) == speed


@given(st.tuples(*[st.floats(0.0, 1.0)] * 4))
def test_thrust_and_torque_follow_from_the_geometry(
    speeds: tuple[float, float, float, float],
) -> None:
    lift = QUAD.thrust_max * np.array(speeds) ** 2
    forces = np.column_stack([np.zeros(4), np.zeros(4), -lift])
    torque = np.cross(POSITIONS, forces).sum(axis=0)
    # The air turns the body against the rotor: clockwise is positive about down.
    torque[2] -= (CLOCKWISE * QUAD.torque_per_thrust * lift).sum()
    thrust, ours = wrench(*speeds, QUAD)
    assert thrust == pytest.approx(lift.sum(), abs=1e-12)
    np.testing.assert_allclose(ours, torque, atol=1e-12)


@pytest.mark.parametrize(
    ("rotor", "signs"),
    [
        (0, (-1, 1, 1)),  # Front right: rolls left, nose up, turns right.
        (1, (1, -1, 1)),  # Rear left: rolls right, nose down, turns right.
        (2, (1, 1, -1)),  # Front left: rolls right, nose up, turns left.
        (3, (-1, -1, -1)),  # Rear right: rolls left, nose down, turns left.
    ],
)
def test_what_each_rotor_alone_does(rotor: int, signs: tuple[int, int, int]) -> None:
    a, b, c, d = (0.7 if i == rotor else 0.0 for i in range(4))
    _, torque = wrench(a, b, c, d, QUAD)
    assert tuple(np.sign(torque)) == signs
    # And the body follows: after a tick it turns that way.
    _, _, _, omega = step(ZERO, ZERO, LEVEL, ZERO, ZERO, torque, QUAD, TICK_S)
    assert tuple(np.sign(omega)) == signs


def test_hover_thrust_of_the_shipped_quad() -> None:
    parameters = load_profile("vehicles", "quad", VehicleProfile).parameters
    speed = steady_speed(parameters["MPC_THR_HOVER"], QUAD.thrust_curve)
    thrust, torque = wrench(speed, speed, speed, speed, QUAD)
    assert thrust == pytest.approx(QUAD.mass * GRAVITY_M_S2, rel=0.01)
    np.testing.assert_allclose(torque, 0.0, atol=1e-12)


# --- drag and closed-form motion


def fly(airframe: Airframe, seconds: float, dt: float, **start: Any) -> tuple[Vec, Vec, Quat, Vec]:
    """Integrate a body that only drag acts on; return position, velocity, attitude, rates."""
    p, v = start.get("p", ZERO), start.get("v", ZERO)
    q, w = start.get("q", LEVEL), start.get("w", ZERO)
    for _ in range(round(seconds / dt)):
        p, v, q, w = step(p, v, q, w, drag_force(v, ZERO, airframe), ZERO, airframe, dt)
    return p, v, q, w


def test_free_fall() -> None:
    vacuum = QUAD._replace(drag_linear=0.0, drag_quadratic=0.0)
    n, dt = 500, TICK_S
    p, v, q, w = fly(vacuum, n * dt, dt, v=(3.0, -2.0, -5.0))
    t = n * dt
    np.testing.assert_allclose(v, (3.0, -2.0, -5.0 + GRAVITY_M_S2 * t), rtol=1e-12)
    # Semi-implicit Euler's fall is exactly t dt g / 2 ahead of the parabola.
    down = -5.0 * t + 0.5 * GRAVITY_M_S2 * t * (t + dt)
    np.testing.assert_allclose(p, (3.0 * t, -2.0 * t, down), rtol=1e-11)
    assert (q, w) == (LEVEL, ZERO)


def test_terminal_velocity_with_linear_drag() -> None:
    airframe = QUAD._replace(drag_linear=1.5, drag_quadratic=0.0)
    terminal = QUAD.mass * GRAVITY_M_S2 / 1.5
    _, v, _, _ = fly(airframe, 20.0, TICK_S)
    assert v[2] == pytest.approx(terminal, rel=1e-6)
    tau = QUAD.mass / 1.5
    _, v, _, _ = fly(airframe, tau, 1e-4)
    assert v[2] == pytest.approx(terminal * (1 - math.exp(-1.0)), rel=1e-3)


def test_terminal_velocity_with_quadratic_drag() -> None:
    airframe = QUAD._replace(drag_linear=0.0, drag_quadratic=0.3)
    _, v, _, _ = fly(airframe, 20.0, TICK_S)
    assert v[2] == pytest.approx(math.sqrt(QUAD.mass * GRAVITY_M_S2 / 0.3), rel=1e-6)


@given(st.tuples(*[st.floats(-20, 20)] * 3), st.tuples(*[st.floats(-10, 10)] * 3))
def test_drag_points_against_the_air(velocity: Vec, wind: Vec) -> None:
    airframe = QUAD._replace(drag_linear=0.4, drag_quadratic=0.1)
    air = np.array(velocity) - np.array(wind)
    expected = -(0.4 + 0.1 * np.linalg.norm(air)) * air
    np.testing.assert_allclose(drag_force(velocity, wind, airframe), expected, atol=1e-9)


# --- rotation

TOP = QUAD._replace(
    inertia_xx=0.03, inertia_yy=0.03, inertia_zz=0.06, drag_linear=0.0, drag_quadratic=0.0
)
SPIN = (1.2, 0.0, 5.0)


def test_symmetric_top_precesses_at_the_closed_form_rate() -> None:
    """w1 + i w2 turns at (I3 - I1)/I1 w3, w3 stays (Landau & Lifshitz, Mechanics, § 36)."""
    t = 2.0
    _, _, _, w = fly(TOP, t, 1e-5, w=SPIN)
    rate = (0.06 - 0.03) / 0.03 * SPIN[2]
    assert w[2] == pytest.approx(SPIN[2], abs=1e-9)
    assert math.hypot(w[0], w[1]) == pytest.approx(1.2, rel=1e-3)
    expected = complex(1.2, 0.0) * complex(math.cos(rate * t), math.sin(rate * t))
    assert abs(complex(w[0], w[1]) - expected) < 2e-3


def euler_reference(airframe: Airframe, w0: Vec, t: float) -> tuple[np.ndarray, np.ndarray]:
    """Attitude (w, x, y, z) and rates after t, by a high-order integrator."""
    inertia = np.array([airframe.inertia_xx, airframe.inertia_yy, airframe.inertia_zz])

    def slope(_t: float, state: np.ndarray) -> np.ndarray:
        q, w = state[:4], state[4:]
        dw = -np.cross(w, inertia * w) / inertia
        dq = 0.5 * np.array(
            [
                -q[1] * w[0] - q[2] * w[1] - q[3] * w[2],
                q[0] * w[0] + q[2] * w[2] - q[3] * w[1],
                q[0] * w[1] - q[1] * w[2] + q[3] * w[0],
                q[0] * w[2] + q[1] * w[1] - q[2] * w[0],
            ]
        )
        return np.concatenate([dq, dw])

    start = np.array([1.0, 0, 0, 0, *w0])
    end = solve_ivp(slope, (0, t), start, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    return end[:4] / np.linalg.norm(end[:4]), end[4:]


@pytest.mark.parametrize("airframe", [TOP, TOP._replace(inertia_yy=0.045)], ids=["top", "skew"])
def test_tumbling_converges_to_the_reference_with_first_order(airframe: Airframe) -> None:
    q_true, w_true = euler_reference(airframe, SPIN, 1.0)
    turn = Rotation.from_quat(quat_wxyz_to_xyzw(q_true))
    steps = np.array([4e-3, 2e-3, 1e-3, 5e-4])
    errors = []
    for dt in steps:
        _, _, q, w = fly(airframe, 1.0, float(dt), w=SPIN)
        away = (turn.inv() * Rotation.from_quat(quat_wxyz_to_xyzw(np.array(q)))).magnitude()
        errors.append((away, np.linalg.norm(np.array(w) - w_true)))
    order = np.polyfit(np.log(steps), np.log(np.array(errors)), 1)[0]
    np.testing.assert_allclose(order, 1.0, atol=0.15)
    # At the simulator's own tick, a second of tumbling at 5 rad/s:
    assert math.degrees(errors[0][0]) < 1.0


@kernel
def _free_flight(
    p: Vec,
    v: Vec,
    q: Quat,
    w: Vec,
    forces: np.ndarray,
    torques: np.ndarray,
    airframe: Airframe,
    dt: float,
) -> tuple[Vec, Vec, Quat, Vec]:
    """Apply world forces and body torques, one row a tick."""
    for i in range(len(forces)):
        force = (forces[i, 0], forces[i, 1], forces[i, 2])
        torque = (torques[i, 0], torques[i, 1], torques[i, 2])
        p, v, q, w = step(p, v, q, w, force, torque, airframe, dt)
    return p, v, q, w


def test_free_body_agrees_with_pybullet() -> None:
    rng = np.random.default_rng(5)
    ticks = 2500
    inertia = (0.02, 0.035, 0.05)
    airframe = QUAD._replace(inertia_xx=inertia[0], inertia_yy=inertia[1], inertia_zz=inertia[2])
    forces = rng.normal(0, 8, (ticks, 3)) - [0, 0, QUAD.mass * GRAVITY_M_S2]
    torques = rng.normal(0, 0.4, (ticks, 3))
    client = bullet_client.BulletClient(pybullet.DIRECT)
    client.setGravity(0, 0, -GRAVITY_M_S2)
    client.setTimeStep(TICK_S)
    shape = client.createCollisionShape(pybullet.GEOM_SPHERE, radius=0.1)
    q0 = np.array([0.5, -0.5, 0.1, 0.7])
    q0 /= np.linalg.norm(q0)
    body = client.createMultiBody(
        QUAD.mass, shape, -1, (0, 0, 0), quat_wxyz_to_xyzw(quat_ned_frd_to_enu_flu(q0))
    )
    # Principal axes of FRD and FLU have the same moments.
    client.changeDynamics(
        body, -1, localInertiaDiagonal=inertia, linearDamping=0.0, angularDamping=0.0
    )
    p, v, q, w = ZERO, ZERO, (float(q0[0]), float(q0[1]), float(q0[2]), float(q0[3])), ZERO
    worst = 0.0
    for start in range(0, ticks, 250):
        rows = slice(start, start + 250)
        p, v, q, w = _free_flight(p, v, q, w, forces[rows], torques[rows], airframe, TICK_S)
        for force, torque in zip(forces[rows], torques[rows], strict=True):
            place, turn = client.getBasePositionAndOrientation(body)
            client.applyExternalForce(body, -1, ned_to_enu(force), place, pybullet.WORLD_FRAME)
            flu = torque * [1, -1, -1]
            world = Rotation.from_quat(turn).apply(flu)
            client.applyExternalTorque(body, -1, world, pybullet.WORLD_FRAME)
            client.stepSimulation()
        place, turn = client.getBasePositionAndOrientation(body)
        worst = max(worst, float(np.abs(ned_to_enu(np.array(place)) - p).max()))
        ours = quat_ned_frd_to_enu_flu(np.array(q))
        theirs = np.array([turn[3], *turn[:3]])
        assert abs(abs(ours @ theirs) - 1.0) < 1e-9
    client.disconnect()
    assert np.linalg.norm(p) > 5.0, "it went somewhere"
    assert worst < 1e-9


def test_a_row_is_an_airframe_field_by_field() -> None:
    numbers = np.arange(1.0, 16.0)
    assert airframe_of(numbers) == Airframe(*numbers)
    assert len(Airframe._fields) == len(numbers)
    assert airframe_of(np.array(QUAD)) == QUAD


@given(st.floats(-0.1, 0.1), st.floats(-0.2, 0.2), st.floats(0.1, 1.0), st.floats(0.1, 1.0))
def test_an_off_centre_mass_is_a_torque_of_its_weight(
    forward: float, right: float, front: float, rest: float
) -> None:
    """About the middle of the rotors the weight W at r exerts r x W: by it the torques differ."""
    off = QUAD._replace(com_forward=forward, com_right=right)
    speeds = (front, rest, rest, front)
    thrust, torque = wrench(*speeds, off)
    _, centred = wrench(*speeds, QUAD)
    wanted = np.array(centred) - np.cross([forward, right, 0.0], [0.0, 0.0, -thrust])
    np.testing.assert_allclose(torque, wanted, atol=1e-12)


@given(st.lists(st.floats(0.0, 1.0), min_size=4, max_size=4))
def test_a_centred_mass_changes_no_bit(speeds: list[float]) -> None:
    """The sums over the arms alone, in the order of the rotors."""
    roll = pitch = 0.0
    for (forward, right, _), speed in zip(POSITIONS, speeds, strict=True):
        thrust = QUAD.thrust_max * speed * speed
        roll -= float(right) * thrust
        pitch += float(forward) * thrust
    s0, s1, s2, s3 = speeds
    assert wrench(s0, s1, s2, s3, QUAD)[1][:2] == (roll, pitch)


@given(st.floats(-0.9, 0.9), st.floats(-0.9, 0.9))
def test_hover_speeds_carry_the_weight_without_torque(forward: float, right: float) -> None:
    share = 0.5 / max(0.5, abs(forward) + abs(right))  # Inside the rotors.
    off = QUAD._replace(
        com_forward=share * forward * QUAD.arm_forward, com_right=share * right * QUAD.arm_right
    )
    thrust, torque = wrench(*hover_speeds(off), off)
    assert thrust == pytest.approx(QUAD.mass * GRAVITY_M_S2, rel=1e-12)
    np.testing.assert_allclose(torque, 0.0, atol=1e-12)


# --- battery


@given(st.floats(5.0, 60.0), st.floats(1e-4, 0.5), st.floats(0.0, 1.0))
def test_voltage_solves_its_equation(emf: float, resistance: float, share: float) -> None:
    power = share * emf**2 / (4 * resistance)
    voltage = terminal_voltage(emf, resistance, power)
    assert voltage == pytest.approx(emf - resistance * power / voltage, rel=1e-6)
    assert voltage >= emf / 2 * (1 - 1e-9)


def test_voltage_at_the_ends() -> None:
    assert terminal_voltage(16.0, 0.02, 0.0) == 16.0
    assert terminal_voltage(16.0, 0.0, 500.0) == 16.0
    assert terminal_voltage(16.0, 0.02, 1e9) == 8.0
    # 16 V, 20 mohm, 300 W: V² - 16 V + 6 = 0.
    assert terminal_voltage(16.0, 0.02, 300.0) == pytest.approx(15.6158, abs=1e-4)


def test_open_circuit_is_linear_in_the_charge() -> None:
    assert [open_circuit(s, 14.0, 16.8) for s in (0.0, 0.5, 1.0)] == [14.0, 15.4, 16.8]


def test_coulombs_are_counted() -> None:
    remaining, current, capacity = 1.0, 25.0, 5200.0
    for _ in range(2500):
        remaining = drain(remaining, current, capacity, TICK_S)
    # 25 A for 10 s = 250 C = 69.44 mAh.
    assert (1.0 - remaining) * capacity == pytest.approx(250.0 / 3.6, rel=1e-9)
    assert drain(0.001, 1000.0, 100.0, 10.0) == 0.0


def test_constant_power_empties_the_battery_when_the_integral_says() -> None:
    """dt = C V(s)/P ds; with R = 0 and V linear in s: T = C (V0 + V1)/2 / P."""
    power, capacity = 300.0, 500.0
    remaining, t = 1.0, 0.0
    while remaining > 0.0:
        voltage = terminal_voltage(open_circuit(remaining, 14.0, 16.8), 0.0, power)
        remaining = drain(remaining, power / voltage, capacity, 0.01)
        t += 0.01
    assert t == pytest.approx(capacity * 3.6 * 0.5 * (14.0 + 16.8) / power, rel=1e-3)
