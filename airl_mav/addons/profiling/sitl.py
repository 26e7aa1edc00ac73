"""Level sitl: every stage of a decision in flight, through the two processes of a rehearsal."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from airl_mav.addons.profiling import measurement, policy_under_test
from airl_mav.core import constants, files
from airl_mav.core.child_process import terminated_as_interrupted
from airl_mav.core.progress import Bar, Progress
from airl_mav.latency.stamps import STAMPS
from airl_mav.rehearsal import channel, run_folder
from airl_mav.rehearsal.observer import LiveObserver
from airl_mav.rehearsal.rehearsal import Rehearsal, RehearsalError
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import ResolvedScenario, resolve

LONGEST_FLIGHT_S = 300.0
"""Maximum flight time: well within a battery, and at walking pace far from every wall."""

MARGIN = 1.1
"""Ratio of a flight's time limit to the expected time of its decisions."""

COLUMNS = (*STAMPS, "accepted_us", "motor_us")


class DecisionEstimate(LiveObserver):
    """Estimates the number of decisions of a flight from the navigation time."""

    def __init__(self, bar: Bar, period_s: float, before: int) -> None:
        """Start from the decisions of earlier flights; one more is made every period."""
        super().__init__(Progress(), Path(), (), 1)
        self._decisions, self._period_us, self._before = bar, period_s * constants.US_PER_S, before
        self._navigating_us: int | None = None

    def phase(self, phase: str, time_us: int) -> None:
        """Store the start time of navigation."""
        if phase == "navigating":
            self._navigating_us = time_us

    def state(self, state: channel.State, started_us: int) -> None:  # noqa: ARG002 (an Observer's names)
        """Show the estimated number of decisions."""
        if self._navigating_us is not None:
            flown = max(0, state.time_us - self._navigating_us) // self._period_us
            self._decisions.update(completed=self._before + flown)


def measure(
    request: measurement.ProfileRequest, policy: policy_under_test.PolicyUnderTest, bar: Bar
) -> measurement.Recording:
    """Fly until there are enough decisions; arguments as `policy_under_test.measure`."""
    # Before the network is opened elsewhere.
    load_us, first_us, later_us = policy_under_test.cold_start(request, policy)
    scenario = resolve(
        Scenario(
            vehicle=policy.vehicle,
            arena="open-field",
            policy=policy.name,
            episodes=1,
            ports=request.ports,
            **request.flown_as,
        )
    )
    # A hold shorter than a frame's interval waits for the next frame.
    frame_s = 1.0 / scenario.vehicle.camera.rate_hz
    period_s = max(request.hold_s + later_us / constants.US_PER_S, frame_s)
    with terminated_as_interrupted():
        try:
            flights = tuple(_flights(request, scenario, period_s, bar))
        except RehearsalError as error:
            raise measurement.ProfilingError(str(error)) from error
    many = f", {len(flights)} flights" if len(flights) > 1 else ""
    return measurement.Recording(
        flights=flights,
        exposure="capture_us",
        load_us=load_us,
        first_us=first_us,
        remarks=(
            f"in flight at real time{many}, hold {request.hold_s:g} s and at most "
            f"{measurement.FLOWN_SPEED_M_S:g} m/s: timing was measured, not the quality of flight",
            "plant, autopilot and camera ran on the same machine",
        ),
    )


def _flights(
    request: measurement.ProfileRequest, scenario: ResolvedScenario, period_s: float, bar: Bar
) -> Iterator[measurement.Stamps]:
    """Yield the stamps of each flight, without warm-up, until there are enough."""
    count = number = 0
    while (missing := request.decisions - count) > 0:
        wanted = request.warm_up + missing
        changes = {
            "seed": request.seed + number,
            "time_limit_s": min(1.0 + MARGIN * wanted * period_s, LONGEST_FLIGHT_S),
        }
        flight = replace(scenario, scenario=scenario.scenario.model_copy(update=changes))
        observer = DecisionEstimate(bar, period_s, count)
        stamps = _fly(flight, observer)
        rows = len(stamps["sent_us"])
        if rows <= request.warm_up:
            (record,) = observer.finished_records
            raise measurement.ProfilingError(
                f"flight {number} gave {rows} decisions; more than the warm-up of "
                f"{request.warm_up} are needed ({'; '.join((record.reason, *record.notes))})"
            )
        yield {name: column[request.warm_up : wanted] for name, column in stamps.items()}
        count, number = count + min(rows, wanted) - request.warm_up, number + 1
        period_s = float(np.diff(stamps["sent_us"]).mean()) / constants.US_PER_S


def _fly(scenario: ResolvedScenario, observer: DecisionEstimate) -> measurement.Stamps:
    """Fly once; return the stamps by the simulator's clock. Raises RehearsalError."""
    with files.scratch_folder("airl-profile-") as scratch:
        path = scratch / "run"
        folder = run_folder.RunFolder.create(
            path, "profile", {}, setup=scenario.setup, seeds=scenario.scenario.seeds
        )
        with Rehearsal(scenario, folder, observer) as rehearsal:
            rehearsal.run()
        latency = run_folder.load(path).latency[0]
    if "sent_us" not in latency:
        raise RehearsalError("the companion left no decisions")
    return {name: np.asarray(latency[name], np.int64) for name in COLUMNS}
