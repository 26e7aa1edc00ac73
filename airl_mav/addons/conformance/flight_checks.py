"""Checks in the air: take-off, setpoints of every kind, their loss, hold, landing."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from airl_mav.addons.conformance import checklist
from airl_mav.addons.conformance.ground_checks import TEXT_S, require_answer
from airl_mav.addons.conformance.telemetry import STOP_BODY, STOP_NED, StepSetpoint
from airl_mav.addons.conformance.vehicle import (
    IGNORE_ALL,
    MODE_S,
    VELOCITY,
    VELOCITY_FORCE_BIT,
    RawSetpoint,
    SetpointStream,
    VehicleConnection,
)

CLIMB_S = 60.0  # Take-off timeout [s]
CLIMB_SHARE = 0.9  # Share of the requested altitude that a take-off must reach
FLY_S = 3.0  # Duration of a velocity setpoint; the last second is measured [s]
CRUISE_M_S = 1.0  # Requested velocity [m/s]
# Velocity tolerance per axis, and minimum change of a flown setpoint [m/s].
VELOCITY_M_S = 0.25
STANDING_M_S = 0.3  # Maximum speed of a stopped vehicle [m/s]
STOP_S = 6.0  # Stop timeout [s]
DRIFT_M = 1.0  # Maximum drift in `FLY_S` of hold [m]
# Landing timeout: height divided by this speed [m/s], plus a constant [s].
LANDING_M_S, LANDING_S = 0.3, 30.0
DISARM_S = 15.0  # Timeout from landing to disarmed [s]
# Duration of a setpoint that may be rejected: less than PX4's offboard-loss time [s].
PROBE_S = 0.8
OBSERVE_S = 1.8  # Observation time of its effect, from its first message [s]
RECOVER_S = 2.0  # Stop time after it [s]
BRAKING = 0.9  # Share of the speed below which a vehicle is braking
# Time error of a STATUSTEXT, stamped by the previous telemetry [s].
TEXT_TIME_S = 0.02
LOSS_MARGIN_S = 2.0  # Additional wait for the reaction to a loss [s]
EAST_DEG = 90.0
NORTH_NED = StepSetpoint("ned", CRUISE_M_S)
FACING_EAST = RawSetpoint(yaw_rad=math.radians(EAST_DEG))
NORTH = RawSetpoint(vx=CRUISE_M_S)


def takeoff(vehicle: VehicleConnection, altitude_m: float) -> str:
    """Take off; expect landed_state ON_GROUND, TAKEOFF, IN_AIR, and the mode after take-off."""
    start_m, start_s = vehicle.height_m, vehicle.telemetry.boot_s
    vehicle.call(
        f"action.set_takeoff_altitude({altitude_m:g})",
        lambda: vehicle.action.set_takeoff_altitude(altitude_m),
        must_succeed=True,
    )
    vehicle.call("action.takeoff()", vehicle.action.takeoff, must_succeed=True)

    def arrived() -> bool:
        climbed = vehicle.height_m - start_m > CLIMB_SHARE * altitude_m
        return climbed and abs(vehicle.velocity_m_s[2]) < STANDING_M_S

    climbed = vehicle.wait_for(arrived, CLIMB_S)
    checklist.require(climbed, f"{vehicle.height_m - start_m:.1f} m after {CLIMB_S:g} s")
    took_s = vehicle.telemetry.boot_s - start_s
    in_air = vehicle.wait_for(lambda: vehicle.landed_state == checklist.LandedState.IN_AIR, MODE_S)
    right_mode = vehicle.reaches_mode(vehicle.autopilot.after_takeoff_mode)
    phases = vehicle.telemetry.landed_states
    finding = f"{vehicle.height_m - start_m:.1f} m after {took_s:.1f} s, {_names(phases)}"
    expected = [
        checklist.LandedState.ON_GROUND,
        checklist.LandedState.TAKEOFF,
        checklist.LandedState.IN_AIR,
    ]
    checklist.require(in_air and phases[-3:] == expected, finding)
    checklist.require(right_mode, f"{finding}; mode {vehicle.mode_name}")
    return f"{finding}, {vehicle.mode_name}"


def start_offboard(vehicle: VehicleConnection, setpoint: StepSetpoint) -> None:
    """Enter offboard by MAVSDK. Raises CheckFailedError without the mode change."""
    vehicle.fly(setpoint)
    vehicle.call("offboard.start()", vehicle.offboard.start, must_succeed=True)
    expected = vehicle.autopilot.mode_name(vehicle.autopilot.offboard_mode)
    offboard = vehicle.reaches_mode(vehicle.autopilot.offboard_mode)
    checklist.require(offboard, f"mode {vehicle.mode_name}, not {expected} within {MODE_S:g} s")


# --- commands and velocities by MAVSDK


def _offboard_without_setpoint(vehicle: VehicleConnection) -> str:
    mode, since = vehicle.mode, len(vehicle.telemetry.texts)
    result = vehicle.set_mode(vehicle.autopilot.offboard, "no setpoint")
    finding = require_answer(vehicle, result, vehicle.autopilot.offboard_in_air, since)
    vehicle.wait(TEXT_S)
    if result:
        checklist.require(vehicle.mode == mode, f"{finding}, and the mode changed")
        finding += ", no change of mode"
    speed_m_s = vehicle.speed_m_s
    checklist.require(speed_m_s < STANDING_M_S, f"{finding}; it moves at {speed_m_s:.2f} m/s")
    return finding


def _disarm(vehicle: VehicleConnection) -> str:
    since = len(vehicle.telemetry.texts)
    result = vehicle.command(checklist.MavCommand.COMPONENT_ARM_DISARM, 0.0, note="disarm")
    finding = require_answer(vehicle, result, vehicle.autopilot.disarm_in_air, since)
    vehicle.wait(TEXT_S)
    checklist.require(vehicle.armed, f"{finding}, and it disarmed")
    return finding


def _offboard_ned(vehicle: VehicleConnection) -> str:
    start_offboard(vehicle, STOP_NED)
    vehicle.wait(FLY_S)
    finding = _velocity(vehicle, NORTH_NED, (CRUISE_M_S, 0.0, 0.0))
    vehicle.fly(STOP_NED)
    vehicle.wait(FLY_S)
    return finding


def _offboard_body(vehicle: VehicleConnection) -> str:
    vehicle.fly(StepSetpoint("ned", 0.0, 0.0, 0.0, EAST_DEG))
    vehicle.wait(FLY_S)
    finding = _velocity(vehicle, StepSetpoint("body", CRUISE_M_S), (0.0, CRUISE_M_S, 0.0))
    vehicle.fly(STOP_BODY)
    vehicle.wait(FLY_S)
    return f"facing east: {finding}"


def _velocity(
    vehicle: VehicleConnection, setpoint: StepSetpoint, expected: tuple[float, float, float]
) -> str:
    vehicle.fly(setpoint)
    vehicle.wait(FLY_S)
    mean = vehicle.telemetry.recent(1.0).velocity.mean(axis=0)
    finding = f"({mean[0]:.2f}, {mean[1]:.2f}, {mean[2]:.2f}) m/s north, east, down"
    checklist.require(np.abs(mean - expected).max() < VELOCITY_M_S, f"{finding}, not {expected}")
    return finding


# --- raw setpoints: frames, type masks, NaN


def _start_raw(vehicle: VehicleConnection) -> str:
    vehicle.wait(FLY_S / 4)
    _request_offboard(vehicle)
    vehicle.wait(FLY_S)
    return f"{vehicle.mode_name} with SET_POSITION_TARGET_LOCAL_NED"


def _request_offboard(vehicle: VehicleConnection) -> None:
    """Enter offboard with a stream of raw setpoints. Raises CheckFailedError."""
    checklist.require(vehicle.set_mode(vehicle.autopilot.offboard, "raw setpoints") == 0, "refused")
    checklist.require(vehicle.reaches_mode(vehicle.autopilot.offboard_mode), "no change of mode")


def _react(stream: SetpointStream, setpoint: RawSetpoint, vehicle: VehicleConnection) -> str:
    """Send a setpoint of 1 m/s and determine the reaction: flown, refused or ignored."""
    frame, mask = setpoint.frame, setpoint.mask
    expected = vehicle.autopilot.frames[frame]
    if mask != VELOCITY:
        expected = vehicle.autopilot.ignore_all if mask == IGNORE_ALL else checklist.Reaction.FLOWN
    telemetry = vehicle.telemetry
    start_s, since = telemetry.boot_s, len(telemetry.texts)
    vehicle.transcript.add(
        "sent",
        f"SET_POSITION_TARGET_LOCAL_NED frame {frame:d} mask {mask:#x} vx 1 for {PROBE_S:g} s",
    )
    stream.send(setpoint)
    vehicle.wait(PROBE_S)
    stream.send(FACING_EAST)
    vehicle.wait(OBSERVE_S - PROBE_S)
    motion = telemetry.recent(OBSERVE_S + 1.0).between(start_s, telemetry.boot_s)
    change = motion.velocity[:, :2] - motion.velocity[0, :2]
    # Facing east, forward is east.
    axis = 0 if frame in (checklist.MavFrame.LOCAL_NED, checklist.MavFrame.LOCAL_OFFSET_NED) else 1
    along, across = change[:, axis].max(), np.abs(change[:, 1 - axis]).max()
    refusal = telemetry.find_text("SET_POSITION_TARGET_LOCAL_NED", since)
    vehicle.wait(RECOVER_S)
    moved = f"{along:.2f} m/s {('north', 'east')[axis]}"
    if along > VELOCITY_M_S > across:
        reaction, finding = checklist.Reaction.FLOWN, f"flown, {moved}"
    elif refusal is not None:
        reaction, finding = checklist.Reaction.REFUSED, f'refused, "{refusal.text}"'
    else:
        reaction, finding = checklist.Reaction.IGNORED, f"ignored, {moved}"
    checklist.require(
        (reaction is checklist.Reaction.FLOWN) == (along > VELOCITY_M_S),
        f"{finding}: {moved}, {across:.2f} m/s across",
    )
    checklist.require(reaction is expected, f"{finding}; expected: {expected.value}")
    return finding


def _nan_velocity(stream: SetpointStream, vehicle: VehicleConnection) -> str:
    """Send a NaN velocity: it is ignored and does not count as a loss of setpoints.

    The check uses the last second's mean velocity: ArduCopter restarts its mode with each such
    setpoint and swings by up to 0.6 m/s.
    """
    stream.send(RawSetpoint(checklist.MavFrame.LOCAL_NED, VELOCITY, vx=None))
    vehicle.transcript.add("sent", "SET_POSITION_TARGET_LOCAL_NED vx NaN for 2 s")
    vehicle.wait(RECOVER_S)
    mode, mode_name = vehicle.mode, vehicle.mode_name
    position = vehicle.telemetry.recent(RECOVER_S / 2).position
    checklist.require(len(position) > 1, "no LOCAL_POSITION_NED")
    moved = position[-1] - position[0]
    north, east, down = moved[1:4] / moved[0]
    stream.send(FACING_EAST)
    vehicle.wait(RECOVER_S / 2)
    finding = f"{mode_name}, ({north:.2f}, {east:.2f}, {down:.2f}) m/s"
    stands = math.hypot(north, east, down) < STANDING_M_S
    return checklist.require(mode == vehicle.autopilot.offboard_mode and stands, finding)


# --- loss of setpoints


def _lose_setpoints(vehicle: VehicleConnection) -> str:
    telemetry = vehicle.telemetry
    with SetpointStream(vehicle, NORTH) as stream:
        vehicle.wait(FLY_S / 4)
        _request_offboard(vehicle)
        vehicle.wait(2.0 * FLY_S)
        cruise = float(telemetry.recent(1.0).velocity[:, 0].mean())
        checklist.require(
            abs(cruise - CRUISE_M_S) < VELOCITY_M_S,
            f"{cruise:.2f} m/s before it, not {CRUISE_M_S:g}",
        )
        stream.stop()
        since = len(telemetry.texts)
        last_s = vehicle.clock.sending_time()
        stream.send(NORTH)
    vehicle.transcript.add("sent", "the last setpoint")
    expected = vehicle.autopilot.loss
    earliest_s, latest_s = expected.starts_s
    wait_s = latest_s + LOSS_MARGIN_S
    if expected.text:
        text = vehicle.wait_for(lambda: telemetry.find_text(expected.text, since), wait_s)
        checklist.require(text, f'no "{expected.text}" in {wait_s:g} s')
        reaction_s, how = text.boot_s - last_s, f'"{text.text}"'
    else:
        vehicle.wait(wait_s)
        motion = telemetry.recent(wait_s + 1.0).between(last_s, math.inf)
        north = motion.velocity[:, 0]
        slower = np.flatnonzero(north < BRAKING * cruise)
        checklist.require(slower.size, f"flies on at {north[-1]:.2f} m/s after {wait_s:g} s")
        reaction_s, how = float(motion.position[slower[0], 0]) - last_s, "brakes"
    right_mode = vehicle.reaches_mode(*expected.modes)
    finding = f"{how} {reaction_s:.2f} s after the last setpoint, {vehicle.mode_name}"
    finding += f", {_motion_after_loss(vehicle, cruise)}"
    checklist.require(
        right_mode and earliest_s - TEXT_TIME_S <= reaction_s <= latest_s + TEXT_TIME_S,
        f"{finding}; expected: {earliest_s:g} to {latest_s:g} s, "
        f"{' or '.join(map(vehicle.autopilot.mode_name, expected.modes))}",
    )
    return finding


def _motion_after_loss(vehicle: VehicleConnection, cruise: float) -> str:
    """Return the motion after the loss. Raises CheckFailedError if not as expected."""

    def level_m_s() -> float:
        return math.hypot(*vehicle.velocity_m_s[:2])

    if (limits := vehicle.autopilot.loss.down_m_s) is None:
        stands = vehicle.wait_for(lambda: level_m_s() < STANDING_M_S, STOP_S)
        checklist.require(stands, f"still moves at {level_m_s():.2f} m/s")
        return "stands"
    vehicle.wait(FLY_S)
    down = float(vehicle.telemetry.recent(1.0).velocity[:, 2].mean())
    finding = f"{level_m_s():.2f} m/s level and {down:.2f} m/s down after {FLY_S:g} s"
    return checklist.require(
        limits[0] < down < limits[1] and level_m_s() < BRAKING * cruise, finding
    )


def _resume_setpoints(vehicle: VehicleConnection) -> str:
    with SetpointStream(vehicle, NORTH):
        vehicle.transcript.add("sent", "setpoints again")
        offboard = vehicle.reaches_mode(vehicle.autopilot.offboard_mode)
        vehicle.wait(FLY_S)
        north = float(vehicle.telemetry.recent(0.5).velocity[:, 0].mean())
    finding = f"{vehicle.mode_name}, {north:.2f} m/s"
    return checklist.require(offboard and abs(north - CRUISE_M_S) < VELOCITY_M_S, finding)


# --- the end of the flight


def hold(vehicle: VehicleConnection) -> str:
    """Leave offboard at 1 m/s; expect hold, a stop, and no drift."""
    start_offboard(vehicle, NORTH_NED)
    vehicle.wait(FLY_S)
    vehicle.call("offboard.stop()", vehicle.offboard.stop, must_succeed=True)
    autopilot = vehicle.autopilot
    expected = " or ".join(map(autopilot.mode_name, autopilot.hold_modes))
    holds = vehicle.reaches_mode(*autopilot.hold_modes)
    checklist.require(holds, f"mode {vehicle.mode_name}, not {expected}")
    start_s = vehicle.telemetry.boot_s
    stands = vehicle.wait_for(lambda: vehicle.speed_m_s < STANDING_M_S, STOP_S)
    checklist.require(
        stands, f"{vehicle.mode_name}: {vehicle.speed_m_s:.2f} m/s after {STOP_S:g} s"
    )
    stopped_s = vehicle.telemetry.boot_s - start_s
    vehicle.wait(FLY_S)
    places = vehicle.telemetry.recent(FLY_S).position[:, 1:4]
    drift_m = float(np.linalg.norm(places - places[-1], axis=1).max())
    finding = f"{vehicle.mode_name}, stands after {stopped_s:.1f} s, drifts {drift_m:.2f} m"
    checklist.require(drift_m < DRIFT_M, f"{finding} in {FLY_S:g} s")
    return finding


def _land(vehicle: VehicleConnection) -> str:
    telemetry = vehicle.telemetry
    before, start_s = len(telemetry.landed_states), telemetry.boot_s
    longest_s = max(vehicle.height_m, 0.0) / LANDING_M_S + LANDING_S
    vehicle.call("action.land()", vehicle.action.land, must_succeed=True)
    mode = vehicle.autopilot.land_mode
    right_mode = vehicle.reaches_mode(mode)
    landed = vehicle.wait_for(
        lambda: vehicle.landed_state == checklist.LandedState.ON_GROUND, longest_s
    )
    checklist.require(landed, f"not on the ground after {longest_s:.0f} s")
    phases = telemetry.landed_states[before:]
    finding = f"{_names(phases)} after {telemetry.boot_s - start_s:.1f} s"
    checklist.require(right_mode, f"{finding}; it was never in {vehicle.autopilot.mode_name(mode)}")
    return checklist.require(
        phases[-2:] == [checklist.LandedState.LANDING, checklist.LandedState.ON_GROUND], finding
    )


def _auto_disarm(vehicle: VehicleConnection) -> str:
    start_s = vehicle.telemetry.boot_s
    checklist.require(
        vehicle.wait_for(lambda: not vehicle.armed, DISARM_S), f"armed after {DISARM_S:g} s"
    )
    vehicle.may_be_armed = False
    return f"disarmed by itself {vehicle.telemetry.boot_s - start_s:.1f} s after landing"


def _names(phases: list[int]) -> str:
    return " -> ".join(checklist.name_of(checklist.LandedState, phase) for phase in phases)


OFFBOARD_CHECKS = (
    checklist.CheckDefinition("offboard without setpoint, in the air", _offboard_without_setpoint),
    checklist.CheckDefinition("disarming in the air", _disarm),
    checklist.CheckDefinition("offboard NED", _offboard_ned),
    checklist.CheckDefinition("offboard body", _offboard_body),
)
LOSS_CHECKS = (
    checklist.CheckDefinition("offboard loss", _lose_setpoints, essential=True),
    checklist.CheckDefinition("setpoints resume", _resume_setpoints),
)
LANDING_CHECKS = (
    checklist.CheckDefinition("land", _land, essential=True, for_steps=True),
    checklist.CheckDefinition("auto-disarm", _auto_disarm, for_steps=True),
)


def setpoint_checks(stream: SetpointStream) -> list[checklist.CheckDefinition]:
    """Return the checks of raw setpoints, facing east, so that forward is not north."""
    probes = {
        f"frame {each:d} {each.name}": RawSetpoint(each, VELOCITY, 1.0)
        for each in checklist.MavFrame
    }
    for mask in (VELOCITY_FORCE_BIT, IGNORE_ALL):
        probes[f"mask {mask:#x}"] = RawSetpoint(checklist.MavFrame.LOCAL_NED, mask, 1.0)
    return [
        checklist.CheckDefinition("raw setpoints", _start_raw, essential=True),
        *(
            checklist.CheckDefinition(name, partial(_react, stream, each))
            for name, each in probes.items()
        ),
        checklist.CheckDefinition("NaN velocity", partial(_nan_velocity, stream)),
    ]
