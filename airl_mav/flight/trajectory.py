"""True path of one episode at 50 Hz, and its quality: time, distance, energy, smoothness."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core import constants, frames
from airl_mav.latency.stages import ages_at_effect, deadline_miss_ratio
from airl_mav.latency.stamps import NO_STAMP, SETPOINT

SAMPLE_US = 20_000
"""Sampling period [µs]: 50 Hz."""


@dataclass(frozen=True)
class Trajectory:
    """n samples of the vehicle's true state; world NED, body FRD."""

    time_us: NDArray[np.int64]  # (n,) simulated time, increasing
    position: NDArray[np.float64]  # (n, 3) NED [m]
    velocity: NDArray[np.float64]  # (n, 3) NED [m/s]
    quaternion: NDArray[np.float64]  # (n, 4) [w, x, y, z] body -> world
    power_w: NDArray[np.float64]  # (n,) electrical power of the vehicle, without its computer
    """Mean since the previous sample, so that power times time equals the energy integrated at the
    full tick rate; NaN without a measurement."""

    def __post_init__(self) -> None:
        """Check shapes and order. Raises ValueError."""
        n = len(self.time_us)
        shapes = {"position": (n, 3), "velocity": (n, 3), "quaternion": (n, 4), "power_w": (n,)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name}: shape {getattr(self, name).shape}, expected {shape}")
        if np.any(np.diff(self.time_us) <= 0):
            raise ValueError("time_us: must increase")

    def __len__(self) -> int:
        """Return n."""
        return len(self.time_us)

    def speed(self) -> NDArray[np.float64]:
        """Return the speed (n,) [m/s], three-dimensional."""
        speed: NDArray[np.float64] = np.linalg.norm(self.velocity, axis=1)
        return speed

    def between(self, start_us: int, end_us: int) -> Trajectory:
        """Return the part from `start_us` to `end_us` [µs], its ends interpolated.

        The part is limited to the recording: it ends at the recording's end, and is empty without
        an overlap.
        """
        if not len(self):
            return self
        start = max(start_us, int(self.time_us[0]))
        end = min(end_us, int(self.time_us[-1]))
        if end < start:
            return self.at(np.zeros(0, np.int64))
        inside = self.time_us[(self.time_us > start) & (self.time_us < end)]
        # Both ends are interpolated: a flight rarely begins or ends at a sample.
        return self.at(np.unique(np.concatenate([[start], inside, [end]]).astype(np.int64)))

    def at(self, times: NDArray[np.int64]) -> Trajectory:
        """Return the state at increasing times [µs]; outside the recording, at its ends."""
        before = np.minimum(np.searchsorted(self.time_us, times, side="left"), len(self) - 1)

        def linear(values: NDArray[np.float64]) -> NDArray[np.float64]:
            at = [np.interp(times, self.time_us, column) for column in values.T]
            return np.stack(at, axis=1)

        quaternion = linear(self._continuous_quaternion())
        quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
        # Power is a mean over the step that ends at a sample; a time inside a step uses its power.
        return Trajectory(
            times, linear(self.position), linear(self.velocity), quaternion, self.power_w[before]
        )

    def _continuous_quaternion(self) -> NDArray[np.float64]:
        """Return the quaternions with signs flipped so that neighbours lie close."""
        dots = np.sum(self.quaternion[1:] * self.quaternion[:-1], axis=1)
        # q and -q are the same attitude; a change of sign would interpolate through zero.
        signs = np.cumprod(np.where(dots < 0.0, -1.0, 1.0))
        near: NDArray[np.float64] = self.quaternion * np.concatenate([[1.0], signs])[:, None]
        return near

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays by field name, for a file."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Trajectory:
        """Build from arrays by field name. Raises KeyError or ValueError if invalid."""
        return cls(**{field.name: arrays[field.name] for field in fields(cls)})


def estimate_of(stamps: Mapping[str, NDArray[Any]]) -> Trajectory | None:
    """Return the path estimated by the flight controller; None if not recorded."""
    if not len(stamps.get("estimate/time_us", ())):
        return None
    names = ("time_us", "position", "velocity", "quaternion")
    arrays = {name: stamps[f"estimate/{name}"] for name in names}
    return Trajectory(**arrays, power_w=np.zeros(len(arrays["time_us"])))


def pose_at(
    path: Trajectory, time_us: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return position (3,), velocity (3,), quaternion (4,) at a time, limited to the recording."""
    time = min(max(time_us, int(path.time_us[0])), int(path.time_us[-1]))
    at = path.between(time, time)
    return at.position[0], at.velocity[0], at.quaternion[0]


@dataclass(frozen=True)
class Leg:
    """Part of a flight."""

    time_s: float
    distance_m: float
    """Path length in three dimensions [m]."""
    energy_j: float | None
    """Electrical energy of the vehicle, without its computer [J]; None: not measured."""


@dataclass(frozen=True)
class Quality:
    """Measures of one episode. All but `takeoff` count from the start of navigation."""

    flight_time_s: float
    distance_m: float
    """Path length in three dimensions [m]."""
    energy_j: float | None
    """Electrical energy of the vehicle, without its computer [J]; None: not measured."""
    computer_energy_j: float
    """Energy of the onboard computer: its watts times the flight time; 0 on the ground [J]."""
    mean_speed_m_s: float
    max_speed_m_s: float
    takeoff: Leg
    endurance_s: float | None = None
    """Endurance of the pack's initial charge at this flight's mean power, with its computer [s];
    None without power, and in older records."""
    range_m: float | None = None
    """Range at the endurance and the flight's mean speed [m]."""
    missions_per_charge: float | None = None
    """Number of such flights per charge."""
    deadline_misses: float | None = None
    """Share of decisions that took effect later than the hold time after their frame was exposed,
    or never (`latency.stages`), 0 to 1. This and the following: None without data and in older
    records."""
    jerk_rms_m_s3: float | None = None
    """RMS jerk of the flown velocity, at the bandwidth of `jerk_of` [m/s³]."""
    jerk_peak_m_s3: float | None = None
    command_jerk_rms_m_s3: float | None = None
    """RMS jerk of the commanded velocity, at the same bandwidth [m/s³]."""
    command_jerk_peak_m_s3: float | None = None
    command_step_m_s: float | None = None
    """Mean step of the commanded velocity at a switch of action [m/s]."""
    command_step_max_m_s: float | None = None

    @property
    def total_energy_j(self) -> float | None:
        """Energy of vehicle and computer together [J]."""
        return None if self.energy_j is None else self.energy_j + self.computer_energy_j


def measure_leg(trajectory: Trajectory, start_us: int, end_us: int) -> Leg:
    """Measure the part of a flight between two simulated times [µs]."""
    part = trajectory.between(start_us, end_us)
    steps_s = np.diff(part.time_us) / constants.US_PER_S
    # Power belongs to the step that ends at a sample, so the first value is left out.
    energy_j = float(np.sum(part.power_w[1:] * steps_s))
    return Leg(
        time_s=(end_us - start_us) / constants.US_PER_S,
        distance_m=float(np.linalg.norm(np.diff(part.position, axis=0), axis=1).sum()),
        energy_j=energy_j if math.isfinite(energy_j) else None,
    )


def measure_quality(
    trajectory: Trajectory,
    navigation_us: int,
    ended_us: int,
    computer_watts: float,
    pack_j: float | None = None,
    *,
    decisions: Mapping[str, NDArray[Any]] | None = None,
    hold_s: float = 0.0,
) -> Quality:
    """Measure an episode from its start to the verdict.

    `pack_j` is the initial energy of the pack (`Battery.energy_j`) [J]; `decisions` are the columns
    of the decision log, as in `latency.npz`. None for unknown values. Actions held for 0 s have no
    deadline.
    """
    if ended_us < navigation_us:
        raise ValueError(f"ended_us={ended_us} lies before navigation_us={navigation_us}")
    leg = measure_leg(trajectory, navigation_us, ended_us)
    speed = trajectory.between(navigation_us, ended_us).speed()
    # Recordings may begin after the start of navigation.
    began_us = min(int(trajectory.time_us[0]), navigation_us) if len(trajectory) else navigation_us
    computer_j = computer_watts * leg.time_s
    spent_j = 0.0 if leg.energy_j is None else leg.energy_j + computer_j
    # Vehicle and computer drain the same pack.
    missions = None if pack_j is None or spent_j <= 0.0 else pack_j / spent_j
    return Quality(
        flight_time_s=leg.time_s,
        distance_m=leg.distance_m,
        energy_j=leg.energy_j,
        computer_energy_j=computer_j,
        mean_speed_m_s=leg.distance_m / leg.time_s if leg.time_s else 0.0,
        max_speed_m_s=float(speed.max()) if speed.size else 0.0,
        takeoff=measure_leg(trajectory, began_us, navigation_us),
        endurance_s=None if missions is None else missions * leg.time_s,
        range_m=None if missions is None else missions * leg.distance_m,
        missions_per_charge=missions,
        **_conduct(trajectory, decisions or {}, navigation_us, ended_us, hold_s),
    )


def _conduct(
    trajectory: Trajectory,
    decisions: Mapping[str, NDArray[Any]],
    start_us: int,
    end_us: int,
    hold_s: float,
) -> dict[str, float | None]:
    """Return the measures of deadlines and smoothness by field; arguments as `measure_quality`."""
    times_us = sample_times(trajectory, start_us, end_us)
    flown = jerk_of(flown_velocity(trajectory, times_us))
    steps = command_steps(decisions)
    commanded = None
    if SETPOINT in decisions:
        commanded = jerk_of(commanded_velocity(trajectory, decisions, times_us))
    misses = None
    # Without a hold time decisions have no deadline.
    if hold_s > 0.0:
        misses = deadline_miss_ratio(ages_at_effect(decisions), hold_s * constants.US_PER_S)
    return {
        "deadline_misses": misses,
        "jerk_rms_m_s3": None if flown is None else flown.rms_m_s3,
        "jerk_peak_m_s3": None if flown is None else flown.peak_m_s3,
        "command_jerk_rms_m_s3": None if commanded is None else commanded.rms_m_s3,
        "command_jerk_peak_m_s3": None if commanded is None else commanded.peak_m_s3,
        "command_step_m_s": float(steps.mean()) if steps.size else None,
        "command_step_max_m_s": float(steps.max()) if steps.size else None,
    }


SAMPLE_S = SAMPLE_US / constants.US_PER_S

BANDWIDTH_HZ = 5.0
"""Half-power bandwidth [Hz]. Well above a multicopter's velocity loop (about 1 Hz), well below the
25 Hz Nyquist frequency of 50 Hz samples."""

SIGMA_S = math.sqrt(math.log(2.0)) / (2.0 * math.pi * BANDWIDTH_HZ)
"""Standard deviation of the Gaussian [s]: its gain is exp(-2 (pi SIGMA_S f)^2)."""

REACH = math.ceil(5.0 * SIGMA_S / SAMPLE_S)
"""Samples to each side that a jerk value uses; the first and last ones have no jerk."""


def _second_derivative() -> NDArray[np.float64]:
    """Return the sampled second derivative of the Gaussian, as a convolution kernel."""
    t = np.arange(-REACH, REACH + 1) * SAMPLE_S
    gauss = np.exp(-0.5 * (t / SIGMA_S) ** 2)
    kernel = (t**2 / SIGMA_S**4 - 1.0 / SIGMA_S**2) * gauss / gauss.sum()
    kernel -= kernel.mean()  # A constant velocity has zero jerk.
    return np.asarray(kernel, np.float64)


_KERNEL = _second_derivative()


@dataclass(frozen=True)
class Jerk:
    """Magnitude of the jerk over a part of a flight, at `BANDWIDTH_HZ`."""

    rms_m_s3: float
    peak_m_s3: float


def jerk_of(velocity: NDArray[np.float64]) -> Jerk | None:
    """Return the jerk of velocities (n, 3) [m/s], sampled at 50 Hz; None with too few samples."""
    # Shorter flights have no sample with a full window.
    if len(velocity) < len(_KERNEL):
        return None
    columns = [np.convolve(column, _KERNEL, "valid") for column in velocity.T]
    squares = np.sum(np.square(columns), axis=0)
    return Jerk(math.sqrt(squares.mean()), math.sqrt(squares.max()))


def sample_times(trajectory: Trajectory, start_us: int, end_us: int) -> NDArray[np.int64]:
    """Return the times (n,) [µs] of an even 50 Hz grid between two times.

    The grid begins at a recorded sample. Evenly sampled recordings, all except real firmware's, are
    therefore not interpolated.
    """
    inside = trajectory.time_us[(trajectory.time_us >= start_us) & (trajectory.time_us <= end_us)]
    if not inside.size:
        return np.zeros(0, np.int64)
    # Even steps: the convolution assumes a constant rate.
    return np.arange(inside[0], inside[-1] + 1, SAMPLE_US, dtype=np.int64)


def flown_velocity(trajectory: Trajectory, times_us: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the true velocity (n, 3) NED [m/s] at times (n,) [µs]."""
    columns = [np.interp(times_us, trajectory.time_us, column) for column in trajectory.velocity.T]
    return np.stack(columns, axis=1)


def commanded_velocity(
    trajectory: Trajectory, decisions: Mapping[str, NDArray[Any]], times_us: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the commanded velocity (n, 3) NED [m/s] at increasing times (n,) [µs].

    A command holds from its sending to the next one's. Before the first one, the command is zero.
    Commands are in the heading frame: they turn with the vehicle's true heading. Watchdog stops
    between commands (`hover_after_s`) are not included. `decisions` has the columns `sent_us` and
    `setpoint` of `latency.npz`.
    """
    sent_us, setpoints = _sent(decisions)
    # Row 0 is the command before the first one was sent.
    commands = np.vstack([np.zeros(3), setpoints])
    flown = commands[np.searchsorted(sent_us, times_us, side="right")]
    # Unwrapped, so that interpolation does not turn the long way round at 180 degrees.
    headings = np.unwrap(frames.quats_to_euler(trajectory.quaternion)[2])
    return frames.heading_to_ned(flown, np.interp(times_us, trajectory.time_us, headings))


def command_steps(decisions: Mapping[str, NDArray[Any]]) -> NDArray[np.float64]:
    """Return the change of the commanded velocity at each switch of action (k - 1,) [m/s].

    The length of the difference between successive commands of k sent. Both use the heading frame
    at the switch, so the length is equal in the world frame.
    """
    _, setpoints = _sent(decisions)
    steps: NDArray[np.float64] = np.linalg.norm(np.diff(setpoints, axis=0), axis=1)
    return steps


def _sent(decisions: Mapping[str, NDArray[Any]]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return times (k,) [µs] and velocities (k, 3) [m/s] of the sent commands."""
    if "sent_us" not in decisions or SETPOINT not in decisions:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    # The last decision of an interrupted flight may not have been sent.
    sent = decisions["sent_us"] != NO_STAMP
    return decisions["sent_us"][sent], decisions[SETPOINT][sent, :3].astype(np.float64)
