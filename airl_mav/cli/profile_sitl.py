"""`airl profile --level sitl`: every stage in flight, through the processes of airl-sitl."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from airl_mav.cli.profile_bare import typical_us
from airl_mav.cli.profile_plan import Measured, ProfilePlan
from airl_mav.cli.sitl import plan as rehearsal_plan
from airl_mav.cli.sitl import terminated_as_interrupted
from airl_mav.cli.sitl_command import SitlCommand, check
from airl_mav.core.constants import US_PER_S
from airl_mav.flight.record import EpisodeRecord
from airl_mav.latency.stamps import STAMPS
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.rehearsal.channel import State, Text
from airl_mav.rehearsal.rehearsal import Rehearsal, RehearsalError
from airl_mav.rehearsal.run_folder import RunFolder, load

PACE_M_S = 0.1
"""Speed limit in flight: far below what a goal or a wall could be reached with."""

LONGEST_FLIGHT_S = 300.0
"""Well within a battery."""

MOST_FLIGHTS = 1000

TOLERANCE = 1.1
"""A flight is planned so much longer than its decisions are expected to take."""

OPEN_FIELD = """\
description = "nothing within 200 m"

[size]
north_m = 500.0
east_m = 500.0

[start]
north_m = 250.0
east_m = 250.0

[goal]
north_m = 240.0
east_m = 0.0
"""

COLUMNS = (*STAMPS, "accepted_us", "motor_us")


class TimingObserver:
    """Tells how many decisions have been flown by now, reckoned by time. An `Observer`."""

    def __init__(self, period_s: float, before: int, progress: Callable[[int], None]) -> None:
        self._period_us = period_s * US_PER_S
        self._before, self._progress = before, progress
        self._navigating_us: int | None = None
        self.ended = ""
        """How the flight ended, in words."""

    def waiting(self, what: str) -> None:
        """Something is being waited for."""

    def episode(self, *_: object) -> None:
        """A flight begins."""
        self._navigating_us = None

    def phase(self, phase: str, time_us: int) -> None:
        """The companion has entered a phase."""
        if phase == "navigating":
            self._navigating_us = time_us

    def state(self, state: State, *_: object) -> None:
        """Time goes on."""
        if self._navigating_us is not None:
            flown = (state.time_us - self._navigating_us) / self._period_us
            self._progress(self._before + max(0, math.floor(flown)))

    def text(self, text: Text) -> None:
        """The autopilot said something."""

    def finished(self, record: EpisodeRecord) -> None:
        """A flight is over."""
        self.ended = "; ".join((record.reason, *record.notes))

    def lost(self, what: str) -> None:
        """A flight was lost and begins again."""


def measure(plan: ProfilePlan, progress: Callable[[int], None]) -> Measured:
    """Fly until there are enough decisions.

    Args:
        plan: What is measured.
        progress: Called with the number of decisions so far.

    Raises:
        UsageError: It cannot be flown as asked.
        RehearsalError: A process was lost too often, or flights bring no decisions.
    """
    command = plan.command
    load_us, first_us, inference_us = typical_us(plan)
    frame_s = 1.0 / load_vehicle(plan.vehicle).camera.rate_hz
    # After a hold as long as a frame's interval a newer frame is always there.
    period_s = max(plan.hold_s + inference_us / US_PER_S, frame_s)
    flights: list[dict[str, NDArray[np.int64]]] = []
    count = 0
    with TemporaryDirectory(prefix="airl-profile-") as scratch, terminated_as_interrupted():
        arena = Path(scratch) / "open-field.toml"
        arena.write_text(OPEN_FIELD, encoding="utf-8")
        while count < command.decisions:
            wanted = command.decisions - count + command.warm_up
            asked = SitlCommand(
                vehicle=plan.vehicle,
                arena=str(arena),
                policy=plan.policy,
                runtime=command.runtime,
                threads=command.threads,
                episodes=1,
                seed=command.seed + len(flights),
                goal_radius=0.5,
                time_limit=min(1.0 + TOLERANCE * wanted * period_s, LONGEST_FLIGHT_S),
                hold=plan.hold_s,
                ports=command.ports,
            )
            observer = TimingObserver(period_s, count, progress)
            stamps = _fly(asked, Path(scratch) / f"{len(flights)}", observer)
            rows = len(stamps["sent_us"])
            if rows <= command.warm_up or len(flights) == MOST_FLIGHTS:
                raise RehearsalError(
                    f"flight {len(flights)} gave {rows} decisions; more than --warm-up "
                    f"{command.warm_up} are needed ({observer.ended})"
                )
            last = command.warm_up + command.decisions - count
            flights.append({k: column[command.warm_up : last] for k, column in stamps.items()})
            count += len(flights[-1]["sent_us"])
            period_s = float(np.diff(stamps["sent_us"]).mean()) / US_PER_S
    many = f", {len(flights)} flights" if len(flights) > 1 else ""
    return Measured(
        flights=tuple(flights),
        seen="capture_us",
        load_us=load_us,
        first_us=first_us,
        remarks=(
            f"in flight at real time{many}, hold {plan.hold_s:g} s and at most {PACE_M_S:g} m/s: "
            "timing was measured, not flying well",
            "plant, autopilot and camera ran on the same machine",
        ),
    )


def _fly(
    command: SitlCommand, path: Path, observer: TimingObserver
) -> dict[str, NDArray[np.int64]]:
    """Fly once; return the stamps by the simulator's clock."""
    setup, pilot = check(command)
    flown = rehearsal_plan(command, setup, pilot, path)
    slow = [*flown.companion.arguments, "--max-speed-m-s", f"{PACE_M_S!r}"]
    flown = replace(flown, companion=replace(flown.companion, arguments=slow))
    folder = RunFolder.create(path, "profile", {}, setup=setup, seeds=(command.seed,))
    with Rehearsal(flown, folder, observer) as rehearsal:
        rehearsal.run()
    latency = load(path).latency[0]
    if "sent_us" not in latency:
        raise RehearsalError("the companion left no decisions")
    return {name: np.asarray(latency[name], np.int64) for name in COLUMNS}
