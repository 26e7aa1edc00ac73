"""Flight record: path, setpoints, estimates and tick lateness."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import TICK_US
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from airl_mav.flight.trajectory import SAMPLE_US, Trajectory
from airl_mav.latency.stamps import NO_STAMP
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.autopilot_state import Wire
from firmware_sim.autopilot.error_state import RATES, P, Q, V
from firmware_sim.engine.record import Record
from firmware_sim.fault_timeline import Acted

Ints = NDArray[np.int64]


class SetpointLog:
    """Times when each offboard setpoint was accepted and first reached the motors."""

    def __init__(self, read_by: Callable[[int], int] | None = None) -> None:
        """Create an empty log.

        `read_by` maps the start of a read [µs] to a time by which the data had arrived [µs]; None =
        reads take no time.
        """
        self._read_by = read_by
        self._accepted: list[tuple[int, Wire]] = []
        self._motor_us: list[int] = []
        """Times when setpoints reached the motors [µs]; `NO_STAMP` = not yet."""
        self.under_way: list[tuple[int, int, int]] = []
        """First and end index of the setpoints taken in a tick, and the ticks until they reach the
        motors. Body rates reach the motors sooner than an earlier velocity."""
        self._taken = 0

    @property
    def fresh(self) -> bool:
        """True if a tick has yet to take accepted setpoints."""
        return len(self._accepted) > self._taken

    def accepted(self, setpoint: Wire, time_us: int) -> None:
        """Record an accepted setpoint whose read began at `time_us` [µs]."""
        if self._read_by is not None:
            time_us = self._read_by(time_us)
        self._accepted.append((time_us, setpoint))
        self._motor_us.append(NO_STAMP)

    def take(self, ticks_to_motors: int) -> None:
        """Record that the next tick takes the accepted setpoints, and the ticks to the motors."""
        self.under_way.append((self._taken, len(self._accepted), ticks_to_motors))
        self._taken = len(self._accepted)

    def flown(self, first_us: int, n: int) -> None:
        """Record the motor commands of the newest n ticks, computed from `first_us` on [µs]."""
        entries, self.under_way = self.under_way, []
        for first, end, ticks in entries:
            if ticks < n:
                self._motor_us[first:end] = [first_us + max(0, ticks) * TICK_US] * (end - first)
            else:
                self.under_way.append((first, end, ticks - n))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return accepted_us (n,), motor_us (n,), setpoint float32 (n, 4)."""
        motor_us = np.array(self._motor_us, np.int64)
        flown = motor_us != NO_STAMP
        wires = np.array([wire for _, wire in self._accepted], np.float32).reshape(-1, 4)
        return {
            "accepted_us": np.array([t for t, _ in self._accepted], np.int64)[flown],
            "motor_us": motor_us[flown],
            "setpoint": wires[flown],
        }


def fault_arrays(acted: Sequence[Acted]) -> dict[str, NDArray[Any]]:
    """Return past and present faults by array name of the episode file; {} without faults."""
    if not acted:
        return {}
    return {
        "faults/fault": np.array([each.fault for each in acted], np.str_),
        "faults/from_us": np.array([each.from_us for each in acted], np.int64),
        "faults/to_us": np.array([each.to_us for each in acted], np.int64),
    }


@kernel
def _sample(times_us: Ints, powers_w: Vector, memory: Vector, sampled: Ints, mean_w: Vector) -> int:
    """Select the sampled ticks and average the power between them; return their number.

    Args:
        times_us: (n,) times of the ticks.
        powers_w: (n,) electrical power [W].
        memory: (4,) time of the last tick and of the last sample [µs], -1 = none; energy since the
            last sample [W µs]; power at the last tick [W]. Updated.
        sampled: (n,) output: indices of the sampled ticks.
        mean_w: (n,) output: mean power since the previous sample [W].
    """
    m = 0
    for k in range(len(times_us)):
        time_us, power_w = times_us[k], powers_w[k]
        if memory[0] >= 0.0:
            memory[2] += power_w * (time_us - memory[0])
        memory[0], memory[3] = time_us, power_w
        first = memory[1] < 0.0
        if first or time_us - memory[1] >= SAMPLE_US:
            mean_w[m] = power_w if first else memory[2] / (time_us - memory[1])
            memory[1], memory[2] = time_us, 0.0
            sampled[m] = k
            m += 1
    return m


class TrajectoryRecorder:
    """Collects the true state of every tick and samples it at 50 Hz."""

    def __init__(self) -> None:
        self._times: list[Ints] = []
        self._states: list[Vector] = []
        """Blocks (m, 10) of samples."""
        self._powers: list[Vector] = []
        self._memory = np.array([-1.0, -1.0, 0.0, 0.0])
        """See `_sample`."""

    def extend(self, times_us: Ints, powers_w: Vector, states: Vector) -> Ints:
        """Add n ticks with states (n, >= 10); return the indices (m,) of the sampled ticks."""
        sampled, mean_w = np.empty(len(times_us), np.int64), np.empty(len(times_us))
        m = _sample(times_us, powers_w, self._memory, sampled, mean_w)
        self._times.append(times_us[sampled[:m]])
        self._powers.append(mean_w[:m])
        self._states.append(states[sampled[:m], :10])
        return sampled[:m]

    def trajectory(self) -> Trajectory:
        """Return the recorded trajectory."""
        rows = np.concatenate([np.zeros((0, 10)), *self._states])
        return Trajectory(
            np.concatenate([np.zeros(0, np.int64), *self._times]),
            rows[:, :3],
            rows[:, 3:6],
            rows[:, 6:],
            np.concatenate([np.zeros(0), *self._powers]),
        )


class FlightRecorder:
    """Record of one episode: true path, setpoints, estimates and tick lateness.

    Grows by about 100 kB per simulated second. Flights without a reader are not recorded.
    """

    def __init__(
        self,
        internals: BuiltinAutopilot | None,
        read_by: Callable[[int], int] | None = None,
    ) -> None:
        """Create an empty record.

        Args:
            internals: Built-in flight controller; None = external firmware.
            read_by: See `SetpointLog`.
        """
        self.setpoints = SetpointLog(read_by)
        """Setpoint log; empty for external firmware."""
        self._internals = internals
        if internals is not None:
            internals.on_setpoint = self.setpoints.accepted
        self.begin()

    def begin(self) -> None:
        """Start the episode: discard the path so far."""
        self._trajectory = TrajectoryRecorder()
        self._estimates: list[Vector] = []
        """Blocks (m, 10) of estimated position, velocity and attitude at the motor commands."""
        self._estimated_us: list[Ints] = []
        self._lateness_us: list[int] = []
        self._slips: list[tuple[int, int]] = []

    def began_tick(self, due_us: int, began_us: int, slipped_us: int) -> None:
        """Record the due time and the begin of a tick that is paced by the wall clock [µs].

        `slipped_us` is the simulated time skipped right before the tick [µs].
        """
        self._lateness_us.append(began_us - due_us)
        if slipped_us:
            self._slips.append((began_us, slipped_us))

    def before_controls(self, ticks: int = 0) -> None:
        """Record that the flight controller takes the accepted setpoints after `ticks` ticks."""
        if self._internals is not None and self.setpoints.fresh:
            self.setpoints.take(self._internals.ticks_to_motors + ticks)

    def flown(self, truths: Record, flown: Record) -> None:
        """Record ticks.

        Args:
            truths: (n,) log of the aircraft.
            flown: (n,) log of the flight controller; without content for external firmware.
        """
        sampled = self._trajectory.extend(truths["time_us"], truths["power_w"], truths["motion"])
        if self._internals is not None:
            self._estimates.append(flown["state"][sampled, :RATES])
            self._estimated_us.append(flown["time_us"][sampled])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the recorded arrays by name in the episode file (docs/reference/run-folder.md)."""
        arrays: dict[str, NDArray[Any]] = {
            "tick/lateness_us": np.array(self._lateness_us, np.int64),
            "tick/slips_us": np.array(self._slips, np.int64).reshape(-1, 2),
        }
        for name, values in self._trajectory.trajectory().arrays().items():
            arrays[f"trajectory/{name}"] = values
        if self._internals is None:
            return arrays
        for name, values in self.setpoints.arrays().items():
            arrays[f"setpoints/{name}"] = values
        estimates = np.concatenate([np.zeros((0, RATES)), *self._estimates])
        return arrays | {
            "estimate/time_us": np.concatenate([np.zeros(0, np.int64), *self._estimated_us]),
            "estimate/position": estimates[:, P:V],
            "estimate/velocity": estimates[:, V:Q],
            "estimate/quaternion": estimates[:, Q:],
        }
