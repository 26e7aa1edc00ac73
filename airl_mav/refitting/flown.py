"""What a refit looks at: a recorded flight, and the vehicle's log of it where there is one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from airl_mav.black_box.messages import Decision, Phase
from airl_mav.black_box.reading import BlackBox
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.flight.trajectory import Trajectory
from airl_mav.report.recorded_flight import NAVIGATING, path_of, stamps_of
from airl_mav.vehicle_log.alignment import Alignment, align
from airl_mav.vehicle_log.ulog import VehicleLog

AIRBORNE_M = 0.8
"""Higher than this above where it stood, ground and its effect are far [m]."""


@dataclass(frozen=True)
class Flown:
    """A recorded flight. Times are the companion's, but for those of the log."""

    box: BlackBox
    path: Trajectory
    """As telemetry told it."""
    stamps: dict[str, NDArray[np.int64]]
    """Of the decisions, by column."""
    setpoints: NDArray[np.float64]
    """(k, 4) forward, right, down [m/s], yaw rate [rad/s]."""
    navigation_us: int
    """From when on the policy flew [µs]."""
    ended_us: int
    """Until when [µs]."""
    airborne_us: tuple[int, int]
    """From when to when it was clear of the ground [µs]."""
    log: VehicleLog | None = None
    clocks: Alignment | None = None
    """How the clocks relate; None without a log."""

    @property
    def sent_us(self) -> NDArray[np.int64]:
        """(k,) when the setpoints were sent [µs]."""
        return self.stamps["sent_us"]

    def logged_us(self, time_us: float) -> float:
        """Return the log's time of what was told at the companion's time [µs]."""
        if self.clocks is None:
            raise ValueError("there is no log")
        return time_us - self.clocks.told_us


def flown_of(box: BlackBox, log: VehicleLog | None) -> Flown:
    """Return a flight with its log.

    Raises:
        UsageError: It holds no navigation, or the log is of another flight.
    """
    decisions = box.all_of(Decision)
    path = path_of(box)
    begun = [each.time_us for each in box.all_of(Phase) if each.phase == NAVIGATING]
    if not begun or not decisions or len(path) < 2:
        raise UsageError(f"{box.path}: no decision was recorded; accepted: a flight that navigated")
    stamps = stamps_of(decisions)
    setpoints = np.asarray(stamps.pop("setpoint"), np.float64)
    after = [
        each.time_us
        for each in box.all_of(Phase)
        if each.time_us >= begun[0] and each.phase != NAVIGATING
    ]
    ended_us = after[0] if after else int(path.time_us[-1])
    clocks = None if log is None else align(path, log, stamps["sent_us"], setpoints)
    return Flown(
        box=box,
        path=path,
        stamps=stamps,
        setpoints=setpoints,
        navigation_us=begun[0],
        ended_us=ended_us,
        airborne_us=_airborne_us(path, begun[0], ended_us),
        log=log,
        clocks=clocks,
    )


def seconds(times_us: NDArray[np.int64], from_us: int) -> NDArray[np.float64]:
    """Return times (n,) [µs] as seconds since a moment."""
    return np.asarray((times_us - from_us) / US_PER_S, np.float64)


def _airborne_us(path: Trajectory, navigation_us: int, ended_us: int) -> tuple[int, int]:
    """Return from when to when, around the navigation, the vehicle was clear of the ground [µs].

    The ground is where the recording began, where that was before take-off; else only the
    navigation counts.
    """
    high = path.position[:, 2] < path.position[0, 2] - AIRBORNE_M
    at = min(int(np.searchsorted(path.time_us, navigation_us)), len(path) - 1)
    if not high[at]:
        return navigation_us, ended_us
    low_before = np.flatnonzero(~high[:at])
    low_after = np.flatnonzero(~high[at:])
    first = 0 if not len(low_before) else int(low_before[-1]) + 1
    last = len(path) - 1 if not len(low_after) else at + int(low_after[0]) - 1
    return int(path.time_us[first]), int(path.time_us[last])
