"""`airl conformance`: checks any flight controller in order, and lands after any failure."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import Field
from rich.console import Console

from airl_mav.addons.conformance import flight_checks, telemetry
from airl_mav.addons.conformance.checklist import (
    RELEASES,
    CheckFailedError,
    Checklist,
    Transcript,
    TranscriptLine,
    require,
)
from airl_mav.addons.conformance.ground_checks import GROUND_CHECKS, heartbeat, version
from airl_mav.addons.conformance.result import (
    AUTO,
    ConformanceResult,
    ConformanceSettings,
    Reference,
    check_table,
    judge,
    line_text,
    step_table,
    summary,
)
from airl_mav.addons.conformance.vehicle import SetpointStream, VehicleConnection
from airl_mav.core import child_process, clock, constants, errors, fields
from airl_mav.core.progress import new_console
from airl_mav.profiles import loading, px4_release
from companion.link_interface import LinkError


class ConformanceOptions(ConformanceSettings):
    """Fly any flight controller through checks and step responses: airl-firmware, PX4, ArduPilot.

    Works with SITL or a board. The vehicle takes off. A complete run needs 60 m to the north, 20 m
    to the east and 15 m above the take-off altitude; Ctrl-C lands. Exit status 1: a check failed.

    Examples:
        airl-firmware --arena open-field
        airl conformance --connect udpin://127.0.0.1:14540 --out result.json
    """

    skip_steps: bool = Field(default=False, description="fly no step responses")
    out: Path | None = Field(
        default=None, description="write everything to this .json; by default nothing"
    )


OPTIONS = ConformanceOptions


def run(options: ConformanceOptions, console: Console | None = None) -> int:
    """Check a vehicle and print the result; return 0 if it conforms, else 1, or 130."""
    console = console or new_console()
    if options.out is not None and not options.out.parent.is_dir():
        raise errors.FieldError("out", str(options.out), problem=f"no folder {options.out.parent}")
    if options.skip_steps and (options.steps_only or options.steps):
        other = "--steps-only" if options.steps_only else "--steps"
        raise errors.FieldError("skip_steps", accepted=f"without {other}")
    if options.steps == ():
        raise errors.FieldError("steps", accepted="one name or more")
    asked = options.model_dump(include=set(ConformanceSettings.model_fields))
    if options.skip_steps:
        asked["steps"] = ()
    with child_process.terminated_as_interrupted():
        result = check_conformance(
            **asked, progress=lambda line: console.print(line_text(line), soft_wrap=True)
        )
    if result.steps and result.reference is not None:
        console.print(step_table(result, result.reference))
    console.print(check_table(result))
    style = "bold green" if result.passed else "bold red"
    console.print(result.verdict, style=style, soft_wrap=True)
    if options.out is not None:
        result.write(options.out)
    if result.interrupted:
        return errors.EXIT_INTERRUPTED
    return 0 if result.passed else errors.EXIT_BROKEN


FACE_NORTH_S = 5.0  # Time before the first step, to turn north and stop [s]
RESCUE_S = 300.0  # Landing timeout after a failure [s]
RESCUE_RETRY_S = 2.0  # Retry interval of an unanswered land request [s]
HEARTBEAT_S = 1.5  # Maximum heartbeat interval [s]


def check_conformance(
    *, progress: Callable[[TranscriptLine], None] = lambda _: None, **settings: Any
) -> ConformanceResult:
    """Fly a flight controller through all checks and step responses. It takes off.

    After any failure and after Ctrl-C the vehicle lands; an interrupted result is `interrupted`.

    Args:
        progress: Called with each line of the transcript, by any thread.
        settings: Fields of `ConformanceSettings`.

    Raises:
        UsageError: Invalid value or connection, port taken, no heartbeat, or unknown autopilot;
            nothing was commanded.
    """
    asked = fields.validated(ConformanceSettings, settings)
    asked.check()
    transcript = Transcript(clock.WallClock(asked.speed), progress)
    checklist = Checklist(transcript)
    result = ConformanceResult(asked, checklist.checks, transcript.lines)
    with closing(VehicleConnection(asked.connect, asked.speed, transcript)) as vehicle:
        transcript.add("note", f"waiting for a flight controller on {asked.connect}")
        try:
            vehicle.connect(asked.connect_timeout_s)
            _check(vehicle, checklist, result)
        except LinkError:
            pass  # Recorded with the failed check.
        except KeyboardInterrupt:
            result.interrupted = True
        result.heartbeat = vehicle.telemetry.latest("HEARTBEAT")
        result.autopilot_version = vehicle.telemetry.latest("AUTOPILOT_VERSION")
    if result.reference is not None and result.steps:
        for name in telemetry.STEP_NAMES:
            if name in asked.flown_steps:
                found, stored = result.steps.get(name), result.reference
                checklist.perform(f"step {name}", partial(judge, found, stored))
    return result


def _check(vehicle: VehicleConnection, checklist: Checklist, result: ConformanceResult) -> None:
    """Make all checks until one blocks the next. Raises UsageError and LinkError."""
    settings = result.settings
    if not checklist.perform("heartbeat", lambda: heartbeat(vehicle)):
        return
    checklist.perform("version", lambda: version(vehicle))
    fields = vehicle.telemetry.latest("AUTOPILOT_VERSION") or {"flight_sw_version": 0}
    title, number = vehicle.autopilot.title, fields["flight_sw_version"]
    column, result.firmware = px4_release.stored_release(title, number)
    vehicle.transcript.add("note", result.firmware)
    vehicle.autopilot = RELEASES.get(column, vehicle.autopilot)
    column = column if settings.reference == AUTO else settings.reference
    result.reference = loading.load_profile("conformance", column, Reference)
    vehicle.unasked_hz = result.reference.streams_hz
    try:
        if checklist.perform_all(GROUND_CHECKS, vehicle, steps_only=settings.steps_only):
            _check_in_air(vehicle, checklist, result)
    finally:
        _bring_down(vehicle, result)


def _check_in_air(
    vehicle: VehicleConnection, checklist: Checklist, result: ConformanceResult
) -> None:
    """Make the checks in the air; the vehicle is armed."""
    settings = result.settings
    checklist.perform("takeoff", lambda: flight_checks.takeoff(vehicle, settings.altitude_m))
    if vehicle.height_m < settings.altitude_m / 2.0:
        return
    if not settings.steps_only:
        checklist.perform_all(flight_checks.OFFBOARD_CHECKS, vehicle)
        vehicle.call("offboard.stop()", vehicle.offboard.stop)
        with SetpointStream(vehicle, flight_checks.FACING_EAST) as stream:
            checklist.perform_all(flight_checks.setpoint_checks(stream), vehicle)
    if settings.flown_steps:
        checklist.perform("step responses", lambda: _fly_steps(vehicle, settings, result.steps))
        vehicle.call("offboard.stop()", vehicle.offboard.stop)
    if not settings.steps_only:
        if not checklist.perform_all(flight_checks.LOSS_CHECKS, vehicle):
            checklist.perform("setpoints resume", partial(require, 0, "not reached"))
        checklist.perform("hold", lambda: flight_checks.hold(vehicle))
    checklist.perform_all(flight_checks.LANDING_CHECKS, vehicle)


def _fly_steps(
    vehicle: VehicleConnection,
    settings: ConformanceSettings,
    measured: dict[telemetry.StepName, telemetry.MeasuredStep],
) -> str:
    """Fly the steps and add their responses. Raises CheckFailedError, LinkError."""
    named = {leg.step.name: leg.step for legs in telemetry.MANOEUVRES for leg in legs if leg.step}
    flight_checks.start_offboard(vehicle, telemetry.STOP_NED)
    vehicle.wait(FACE_NORTH_S)
    for repetition in range(settings.repeat):
        for leg in telemetry.plan(settings.flown_steps, mirrored=repetition % 2 == 1):
            response = _fly_leg(vehicle, leg)
            if leg.step is not None and response is not None:
                name = leg.step.name
                vehicle.transcript.add("note", f"{name}: {summary(response)}")
                measured.setdefault(name, telemetry.MeasuredStep(named[name], [])).flights.append(
                    response
                )
    steps = sum(len(each.flights) for each in measured.values())
    finding = f"{steps} steps, timed by {vehicle.clock.method.value}"
    inexact = vehicle.clock.inexact
    return finding + (f", {inexact} setpoints only by the newest telemetry" if inexact else "")


def _fly_leg(
    vehicle: VehicleConnection, leg: telemetry.HeldSetpoint
) -> telemetry.StepResponse | None:
    """Hold a setpoint for its duration; return the response to its step."""
    sent_s = vehicle.fly(leg.setpoint)
    vehicle.wait(leg.seconds - (vehicle.telemetry.boot_s - sent_s))
    offboard = vehicle.mode == vehicle.autopilot.offboard_mode
    require(offboard, f"it left offboard: {vehicle.mode_name}")
    if leg.step is None:
        return None
    motion = vehicle.telemetry.recent(leg.seconds + 2.0 * telemetry.BEFORE_S)
    try:
        motion = motion.between(sent_s - telemetry.BEFORE_S, sent_s + leg.seconds)
        return telemetry.measure(leg.step, motion, sent_s)
    except ValueError as error:
        raise CheckFailedError(f"{leg.step.name}: {error}") from None


def _bring_down(vehicle: VehicleConnection, result: ConformanceResult) -> None:
    """Land if still armed; repeat the request until answered. Ctrl-C aborts the landing."""
    if not vehicle.may_be_armed:
        return
    note = vehicle.transcript.add
    with suppress(LinkError):
        # The heartbeat, once a second, may not report it yet.
        vehicle.wait_for(lambda: vehicle.armed, HEARTBEAT_S)
    if not vehicle.armed and vehicle.telemetry.silence_s < HEARTBEAT_S:
        return
    note("note", "still armed: landing")
    result.known_to_be_down = answered = False
    stopwatch = clock.WallClock(vehicle.speed)
    try:
        while stopwatch.time_us() < RESCUE_S * constants.US_PER_S:
            try:
                answered = answered or not vehicle.call("action.land()", vehicle.action.land)
                if vehicle.wait_for(lambda: not vehicle.armed, RESCUE_RETRY_S):
                    result.known_to_be_down = True
                    note("note", "landed and disarmed")
                    return
            except LinkError as error:
                # The link may recover.
                note("note", f"{error}: trying to land")
                answered = False
                retry_us = stopwatch.time_us() + int(RESCUE_RETRY_S * constants.US_PER_S)
                stopwatch.sleep_until(retry_us)
    finally:
        if not result.known_to_be_down:
            note("note", "NOT known to be down: take over")
