"""Data of a recorded flight for export: estimates, decisions, battery."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.view.replayed_flight import ReplayedFlight
from airl_mav.black_box.messages import Decision
from airl_mav.core import constants, frames
from airl_mav.flight.trajectory import Trajectory, estimate_of, pose_at
from airl_mav.latency.stamps import NO_STAMP, SETPOINT, SETPOINTS, STAMPS, setpoint_column
from airl_mav.rehearsal.run_folder import RunInfo
from airl_mav.vehicle.power import drain, open_circuit, terminal_voltage

RECORDED_LEVEL = "flight"
"""Level of a run recorded by a companion, without a true path."""


@dataclass(frozen=True)
class RecordedFlight:
    """Flight and its run. Times are simulated [µs]."""

    replayed: ReplayedFlight
    info: RunInfo

    @property
    def truth(self) -> Trajectory | None:
        """True path; None if unknown."""
        return None if self.info.setup.level == RECORDED_LEVEL else self.replayed.path

    @property
    def estimate(self) -> Trajectory | None:
        """Path estimated by the flight controller; None if not recorded."""
        return estimate_of(self.replayed.stamps)

    @property
    def believed(self) -> Trajectory:
        """Path reported to the companion; the recorded path without estimates."""
        return self.estimate or self.replayed.path

    @property
    def decisions(self) -> dict[str, NDArray[Any]]:
        """Columns of the sent decisions, one row each."""
        stamps = self.replayed.stamps
        columns = {
            name: stamps[name]
            for name in (*STAMPS, *SETPOINTS.values(), "accepted_us", "motor_us")
            if name in stamps
        }
        sent = columns.get("sent_us", np.zeros(0, np.int64)) != NO_STAMP
        return {name: column[sent] for name, column in columns.items()}


@dataclass(frozen=True)
class Charge:
    """Battery state (n,) at the times of the path."""

    voltage_v: NDArray[np.float64]
    current_a: NDArray[np.float64]
    discharged_mah: NDArray[np.float64]
    remaining: NDArray[np.float64]
    """Remaining charge, 1 full to 0 empty."""


def charge_of(flight: RecordedFlight) -> Charge | None:
    """Return the battery state computed as in the simulator; None without the true path."""
    path, battery = flight.truth, flight.replayed.vehicle.battery
    if path is None:
        return None
    empty_v, full_v = battery.cells * battery.cell_empty_v, battery.cells * battery.cell_full_v
    left = float(flight.info.config.get("battery_charge") or 1.0)
    first = left
    rows = np.zeros((len(path), 4))
    steps_s = np.diff(path.time_us, prepend=path.time_us[:1]) / constants.US_PER_S
    loads_w = path.power_w + flight.info.setup.computer_watts
    for i, (step_s, load_w) in enumerate(zip(steps_s.tolist(), loads_w.tolist(), strict=True)):
        rest_v = open_circuit(left, empty_v, full_v)
        voltage = terminal_voltage(rest_v, battery.resistance_ohm, load_w)
        current = load_w / voltage
        left = drain(left, current, battery.capacity_mah, step_s)
        rows[i] = voltage, current, (first - left) * battery.capacity_mah, left
    return Charge(*rows.T)


def decision_messages(flight: RecordedFlight) -> list[Decision]:
    """Return the decisions as black-box messages, with the state at the start of inference."""
    columns, believed = flight.decisions, flight.believed
    setpoints = columns.get(setpoint_column(columns) or SETPOINT, np.zeros((0, 4)))
    goal = flight.replayed.record.goal
    held_before_us, found = NO_STAMP, []
    for i in range(len(setpoints)):
        stamps = {name: int(columns[name][i]) for name in STAMPS}
        position, velocity, quaternion = pose_at(believed, stamps["infer_start_us"])
        found.append(
            Decision(
                **stamps,
                held_before_us=held_before_us,
                position=tuple(position.tolist()),
                velocity=tuple(velocity.tolist()),
                quaternion=tuple(quaternion.tolist()),
                goal_away_m=frames.goal_distance_m(goal, position),
                setpoint=tuple(setpoints[i].astype(float).tolist()),
            )
        )
        held_before_us = stamps["held_until_us"]
    return found
