"""Checks in the air, by MAVSDK's own calls: take-off, flight by setpoints, hold, landing."""

from __future__ import annotations

import math

import numpy as np

from airl_mav.conformance.checks import FailedError, require
from airl_mav.conformance.ground import TEXT_S, expect
from airl_mav.conformance.session import Session
from airl_mav.conformance.steps import STILL, Body, Ned, Setpoint
from airl_mav.conformance.words import (
    COMPONENT_ARM_DISARM,
    IN_AIR,
    LANDING,
    ON_GROUND,
    TAKEOFF,
    landed_name,
)

CLIMB_S = 60.0
"""Longest take-off [s]."""

THERE = 0.9
"""Share of the altitude asked for that a take-off must reach."""

MODE_S = 3.0
"""Longest wait until the heartbeat, which comes each second, shows a new mode [s]."""

FLY_S = 3.0
"""A velocity is held for so long; its last second is looked at [s]."""

NEAR_M_S = 0.25
"""A velocity is the one asked for when no axis is farther off [m/s]."""

STANDING_M_S = 0.3
"""Slower than this is standing [m/s]."""

STOP_S = 6.0
"""Longest time until it stands [s]."""

DRIFT_M = 1.0
"""It may drift so far in `FLY_S` while it holds [m]."""

LANDING_M_S = 0.3
"""Slowest landing that is waited for, on average [m/s]..."""

LANDING_S = 30.0
"""...and so much longer [s]."""

DISARM_S = 15.0
"""Longest wait from the ground to disarmed [s]."""

FACING_EAST_DEG = 90.0


def takeoff(session: Session, altitude_m: float) -> str:
    """Take off, and see its landed_state go through the phases."""
    start_m, start_s = height(session), session.inbox.boot_s
    session.must(
        f"action.set_takeoff_altitude({altitude_m:g})",
        lambda: session.action.set_takeoff_altitude(altitude_m),
    )
    session.must("action.takeoff()", session.action.takeoff)

    def there() -> bool:
        climbed = height(session) - start_m > THERE * altitude_m
        return climbed and abs(velocity(session)[2]) < STANDING_M_S

    if not session.wait(there, CLIMB_S):
        raise FailedError(f"{height(session) - start_m:.1f} m after {CLIMB_S:g} s")
    took_s = session.inbox.boot_s - start_s
    in_air = session.wait(lambda: session.landed == IN_AIR, MODE_S)
    mode = session.family.after_takeoff_mode
    named = session.wait(lambda: session.mode == mode, MODE_S)
    states = session.inbox.landed_states
    order = " -> ".join(landed_name(state) for state in states)
    finding = f"{height(session) - start_m:.1f} m after {took_s:.1f} s, {order}"
    require(bool(in_air) and states[-3:] == [ON_GROUND, TAKEOFF, IN_AIR], finding)
    require(bool(named), f"{finding}; mode {session.inbox.mode_name(session.mode)}")
    return f"{finding}, {session.inbox.mode_name(mode)}"


def offboard_without_setpoint(session: Session) -> str:
    """Ask for flight by setpoints in the air, without any."""
    mode, since = session.mode, len(session.inbox.texts)
    expected = session.family.offboard_in_air
    result = session.set_mode(session.family.offboard, "no setpoint")
    finding = expect(session, result, expected, since)
    session.let(TEXT_S)
    if result:
        require(session.mode == mode, f"{finding}, and the mode changed")
        finding += ", no change of mode"
    require(speed(session) < STANDING_M_S, f"{finding}; it moves at {speed(session):.2f} m/s")
    return finding


def disarm_refused(session: Session) -> str:
    """Ask for disarming in the air."""
    since = len(session.inbox.texts)
    result = session.command(COMPONENT_ARM_DISARM, 0.0, note="disarm")
    finding = expect(session, result, session.family.disarm_in_air, since)
    session.let(TEXT_S)
    require(session.armed, f"{finding}, and it disarmed")
    return finding


def offboard_ned(session: Session) -> str:
    """Fly north by MAVSDK's set_velocity_ned."""
    start_offboard(session, Ned(0.0, 0.0, 0.0, 0.0))
    session.let(FLY_S)
    finding = _flies(session, Ned(1.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    session.fly(Ned(0.0, 0.0, 0.0, 0.0))
    session.let(FLY_S)
    return finding


def offboard_body(session: Session) -> str:
    """Face east and fly forward by MAVSDK's set_velocity_body: that is east too."""
    session.fly(Ned(0.0, 0.0, 0.0, FACING_EAST_DEG))
    session.let(FLY_S)
    finding = _flies(session, Body(1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    session.fly(STILL)
    session.let(FLY_S)
    return f"facing east: {finding}"


def hold(session: Session) -> str:
    """Leave flight by setpoints at walking pace, and stand."""
    start_offboard(session, Ned(1.0, 0.0, 0.0, 0.0))
    session.let(FLY_S)
    session.must("offboard.stop()", session.offboard.stop)
    family = session.family
    name = session.inbox.mode_name
    require(
        bool(session.wait(lambda: session.mode in family.hold_modes, MODE_S)),
        f"mode {name(session.mode)}, not {' or '.join(map(name, family.hold_modes))}",
    )
    start_s = session.inbox.boot_s
    require(
        bool(session.wait(lambda: speed(session) < STANDING_M_S, STOP_S)),
        f"{name(session.mode)}: {speed(session):.2f} m/s after {STOP_S:g} s",
    )
    stood_s = session.inbox.boot_s - start_s
    session.let(FLY_S)
    places = session.inbox.recent(FLY_S).motion[:, 1:4]
    drift_m = float(np.linalg.norm(places - places[-1], axis=1).max())
    finding = f"{name(session.mode)}, stands after {stood_s:.1f} s, drifts {drift_m:.2f} m"
    require(drift_m < DRIFT_M, f"{finding} in {FLY_S:g} s")
    return finding


def land(session: Session) -> str:
    """Land, and be disarmed by the autopilot itself."""
    before, start_s = len(session.inbox.landed_states), session.inbox.boot_s
    longest_s = max(height(session), 0.0) / LANDING_M_S + LANDING_S
    session.must("action.land()", session.action.land)
    mode = session.family.land_mode
    named = session.wait(lambda: session.mode == mode, MODE_S)
    if not session.wait(lambda: session.landed == ON_GROUND, longest_s):
        raise FailedError(f"not on the ground after {longest_s:.0f} s")
    down_s = session.inbox.boot_s - start_s
    states = session.inbox.landed_states[before:]
    finding = f"{' -> '.join(map(landed_name, states))} after {down_s:.1f} s"
    require(bool(named), f"{finding}; it was never in {session.inbox.mode_name(mode)}")
    require(states[-2:] == [LANDING, ON_GROUND], finding)
    return finding


def auto_disarm(session: Session) -> str:
    """Wait until it disarms by itself."""
    start_s = session.inbox.boot_s
    require(bool(session.wait(lambda: not session.armed, DISARM_S)), f"armed after {DISARM_S:g} s")
    session.arming = False
    return f"disarmed by itself {session.inbox.boot_s - start_s:.1f} s after landing"


def start_offboard(session: Session, setpoint: Setpoint) -> None:
    """Begin flight by MAVSDK's setpoints. Raises FailedError when the mode does not come."""
    session.fly(setpoint)
    session.must("offboard.start()", session.offboard.start)
    mode = session.family.offboard_mode
    require(
        bool(session.wait(lambda: session.mode == mode, MODE_S)),
        f"mode {session.inbox.mode_name(session.mode)}, "
        f"not {session.inbox.mode_name(mode)} within {MODE_S:g} s",
    )


def height(session: Session) -> float:
    """Height above the origin, by its estimate [m]."""
    fields = session.inbox.latest("LOCAL_POSITION_NED")
    return -float(fields["z"]) if fields else 0.0


def velocity(session: Session) -> tuple[float, float, float]:
    """North, east, down, by its estimate [m/s]."""
    fields = session.inbox.latest("LOCAL_POSITION_NED") or {}
    return fields.get("vx") or 0.0, fields.get("vy") or 0.0, fields.get("vz") or 0.0


def speed(session: Session) -> float:
    """Speed, by its estimate [m/s]."""
    return math.hypot(*velocity(session))


def _flies(session: Session, setpoint: Setpoint, expected: tuple[float, float, float]) -> str:
    session.fly(setpoint)
    session.let(FLY_S)
    mean = session.inbox.recent(1.0).motion[:, 4:7].mean(axis=0)
    finding = f"({mean[0]:.2f}, {mean[1]:.2f}, {mean[2]:.2f}) m/s north, east, down"
    require(float(np.abs(mean - expected).max()) < NEAR_M_S, f"{finding}, not {expected}")
    return finding
