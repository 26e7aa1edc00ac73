"""Flying the steps of `steps` and comparing them with a stored column."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

from airl_mav.conformance.air import start_offboard
from airl_mav.conformance.checks import Checklist, FailedError, require
from airl_mav.conformance.reference import Reference, StoredStep, misses
from airl_mav.conformance.session import Session
from airl_mav.conformance.step_response import StepResponse, median_response
from airl_mav.conformance.steps import (
    MANOEUVRES,
    NORTHWARD,
    QUIET_S,
    STEP_NAMES,
    Leg,
    Step,
    StepName,
    measure,
    plan,
)

FACE_NORTH_S = 5.0
"""Before the first step: to turn north, and stand [s]."""


class FlownStep(NamedTuple):
    """A step and its responses, one a repetition."""

    step: Step
    flights: list[StepResponse]

    @property
    def median(self) -> StepResponse:
        """Median over the repetitions."""
        return median_response(self.flights)


def fly_steps(
    session: Session, names: tuple[StepName, ...], repeat: int, flown: dict[StepName, FlownStep]
) -> str:
    """Fly the named steps.

    Args:
        session: The vehicle, in the air.
        names: Which steps.
        repeat: How often; every other time mirrored, so that it comes back.
        flown: Where the responses go, as they come.

    Returns:
        A finding.

    Raises:
        FailedError: It left flight by setpoints.
    """
    steps = {leg.step.name: leg.step for legs in MANOEUVRES for leg in legs if leg.step}
    start_offboard(session, NORTHWARD)
    session.let(FACE_NORTH_S)
    inexact = 0
    for turn in range(repeat):
        for leg in plan(names, mirrored=turn % 2 == 1):
            response, exact = _fly_leg(session, leg)
            inexact += not exact
            if leg.step is not None and response is not None:
                name = leg.step.name
                session.transcript.say("note", f"{name}: {_summary(response)}")
                flown.setdefault(name, FlownStep(steps[name], [])).flights.append(response)
    times = f"timed by {session.vehicle_clock.method.value}"
    if inexact:
        times += f", {inexact} setpoints only by the newest telemetry"
    return f"{sum(len(each.flights) for each in flown.values())} steps, {times}"


def judge_steps(
    checklist: Checklist,
    names: tuple[StepName, ...],
    flown: dict[StepName, FlownStep],
    reference: Reference,
) -> None:
    """Compare every step with the stored column: one check each."""
    for name in STEP_NAMES:
        if name in names:
            checklist.perform(f"step {name}", partial(_judge, flown.get(name), reference))


def stored_step(reference: Reference, name: StepName) -> StoredStep:
    """Return what is stored of a step: nothing when there is nothing."""
    return reference.steps.get(name, StoredStep())


def _fly_leg(session: Session, leg: Leg) -> tuple[StepResponse | None, bool]:
    """Hold a setpoint for its time; return the response, and whether its time is exact."""
    sent_s, exact = session.fly(leg.setpoint)
    session.let(leg.seconds - (session.inbox.boot_s - sent_s))
    mode = session.inbox.mode_name(session.mode)
    require(session.mode == session.family.offboard_mode, f"it left flight by setpoints: {mode}")
    if leg.step is None:
        return None, exact
    end_s = sent_s + leg.seconds
    track = session.inbox.recent(leg.seconds + 2.0 * QUIET_S).between(sent_s - QUIET_S, end_s)
    try:
        return measure(leg.step, track, sent_s), exact
    except ValueError as error:
        raise FailedError(f"{leg.step.name}: {error}") from None


def _judge(flown: FlownStep | None, reference: Reference) -> str:
    if flown is None:
        raise FailedError("not flown")
    stored = reference.steps.get(flown.step.name)
    if stored is None:
        raise FailedError(f"nothing stored for {reference.title}")
    median = flown.median
    found = misses(median, stored, reference.tolerance)
    if found:
        raise FailedError("; ".join(_words(*miss) for miss in found))
    return _summary(median)


def _summary(response: StepResponse) -> str:
    return (
        f"latency {1e3 * response.latency_s:.0f} ms, rise {1e3 * response.rise_s:.0f} ms, "
        f"overshoot {max(response.overshoot_percent, 0.0):.1f} %"
    )


def _words(figure: str, measured: float, stored: float, allowed: float) -> str:
    name, _, unit = figure.rpartition("_")
    sign, scale, digits = ("%", 1.0, 1) if unit == "percent" else ("ms", 1e3, 0)
    points = "points" if unit == "percent" else "ms"
    return (
        f"{name} {scale * measured:.{digits}f} {sign}, stored {scale * stored:.{digits}f} "
        f"+- {scale * allowed:.{digits}f} {points}"
    )
