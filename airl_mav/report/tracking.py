"""How a flight followed its commands: commanded, flown and estimated motion on one time axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_S
from airl_mav.core.files import Arrays
from airl_mav.core.frames import ned_to_heading, quats_to_euler
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.trajectory import Trajectory
from airl_mav.latency.stamps import NO_STAMP
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report.forensics.worst import flown_path

Floats = NDArray[np.float64]

MOTOR_TIMES, MOTOR_OUTPUTS = "motors/time_us", "motors/output"
"""Columns of a flight with the vehicle's log: (n,) [µs] and (n, 4), 0 to 1, in PX4's order."""


@dataclass(frozen=True)
class Motion:
    """How a vehicle moves, at m moments: as it was, or as its estimator had it."""

    forward_m_s: Floats
    """(m,) velocity along the own heading, level."""
    right_m_s: Floats
    height_m: Floats
    """(m,) above the start."""
    yaw_rate_deg_s: Floats
    """(m,) clockwise seen from above: the heading's difference from sample to sample."""
    roll_deg: Floats
    pitch_deg: Floats


@dataclass(frozen=True)
class Commands:
    """The setpoints of n decisions; each holds until the next one is sent."""

    sent_s: Floats
    """(n,) since the start of navigation."""
    forward_m_s: Floats
    """(n,) along the heading, which the vehicle may turn meanwhile."""
    right_m_s: Floats
    yaw_rate_deg_s: Floats


@dataclass(frozen=True)
class EstimateErrors:
    """How far the estimator was from the truth, at m moments."""

    aside_m: Floats
    """(m,) between estimated and true position, seen from above."""
    height_m: Floats
    """(m,) of the height, without its sign."""
    velocity_m_s: Floats
    """(m,) length of the velocity's error."""
    tilt_deg: Floats
    """(m,) the larger of the errors of roll and pitch."""
    heading_deg: Floats


@dataclass(frozen=True)
class TrackedFlight:
    """A flight up to its verdict."""

    record: EpisodeRecord
    time_s: Floats
    """(m,) since the start of navigation; negative before it."""
    flown: Motion
    estimated: Motion | None
    """None: nothing was recorded of an estimator."""
    errors: EstimateErrors | None
    commands: Commands
    altitude_m: float | None
    """Height that was to be held."""
    power_w: Floats
    motors: Floats | None
    """(m, 4) motor outputs 0 to 1, in PX4's order; None: not recorded."""


def track(run: LoadedRun, record: EpisodeRecord) -> TrackedFlight | None:
    """Return how a flight followed its commands; None where no path of it is recorded."""
    path = flown_path(run, record)
    if path is None or len(path) < 2:
        return None
    stamps = run.latency.get(record.index, {})
    zero_us = record.started_us if record.navigation_us is None else record.navigation_us
    flown, heading = _motion(path.time_us, path.position, path.velocity, path.quaternion)
    estimated = errors = None
    if len(stamps.get("estimate/time_us", ())) > 1:
        believed = _at(stamps, path.time_us)
        estimated, estimated_heading = _motion(
            path.time_us, believed.position, believed.velocity, believed.quaternion
        )
        errors = _errors(path, flown, heading, believed, estimated, estimated_heading)
    return TrackedFlight(
        record=record,
        time_s=(path.time_us - zero_us) / US_PER_S,
        flown=flown,
        estimated=estimated,
        errors=errors,
        commands=commands_of(stamps, zero_us),
        altitude_m=run.info.config.get("pilot", {}).get("altitude_m"),
        power_w=path.power_w,
        motors=_motors(stamps, path.time_us),
    )


def _motors(stamps: Arrays, time_us: NDArray[np.int64]) -> Floats | None:
    """Return the motor outputs (m, 4) at times (m,); zero before and after they are known."""
    times, outputs = stamps.get(MOTOR_TIMES), stamps.get(MOTOR_OUTPUTS)
    if times is None or outputs is None or len(times) < 2:
        return None
    columns = [np.interp(time_us, times, column, left=0.0, right=0.0) for column in outputs.T]
    return np.stack(columns, axis=1)


def commands_of(stamps: Arrays, zero_us: int) -> Commands:
    """Return the setpoints that were sent, as time counts from `zero_us`."""
    sent = np.asarray(stamps.get("sent_us", np.zeros(0)), np.int64)
    setpoint = np.asarray(stamps.get("setpoint", np.zeros((len(sent), 4))), np.float64)
    there = sent != NO_STAMP
    forward, right, _, turn = setpoint[there].T if there.any() else np.zeros((4, 0))
    return Commands((sent[there] - zero_us) / US_PER_S, forward, right, np.degrees(turn))


def _motion(
    time_us: NDArray[np.int64], position: Floats, velocity: Floats, quaternion: Floats
) -> tuple[Motion, Floats]:
    """Return motion and heading (m,) [rad], the latter without jumps."""
    roll, pitch, yaw = quats_to_euler(quaternion)
    heading: Floats = np.unwrap(yaw)
    level = ned_to_heading(velocity, heading)
    rate = np.gradient(heading, time_us / US_PER_S)
    motion = Motion(
        forward_m_s=level[:, 0],
        right_m_s=level[:, 1],
        height_m=-position[:, 2],
        yaw_rate_deg_s=np.degrees(rate),
        roll_deg=np.degrees(roll),
        pitch_deg=np.degrees(pitch),
    )
    return motion, heading


def _at(stamps: Arrays, time_us: NDArray[np.int64]) -> Trajectory:
    """Return the estimates, linear between their samples, at other times (m,)."""
    times = stamps["estimate/time_us"]
    quaternion = stamps["estimate/quaternion"]
    # q and -q are the same attitude: what is between two samples must not pass through zero.
    flips = np.where(np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0.0, -1.0, 1.0)
    near = quaternion * np.cumprod(np.concatenate([[1.0], flips]))[:, None]

    def linear(values: Floats) -> Floats:
        return np.stack([np.interp(time_us, times, column) for column in values.T], axis=1)

    turned = linear(near)
    return Trajectory(
        time_us,
        linear(stamps["estimate/position"]),
        linear(stamps["estimate/velocity"]),
        turned / np.linalg.norm(turned, axis=1, keepdims=True),
        np.zeros(len(time_us)),
    )


def _errors(
    path: Trajectory,
    flown: Motion,
    heading: Floats,
    believed: Trajectory,
    estimated: Motion,
    estimated_heading: Floats,
) -> EstimateErrors:
    away = believed.position - path.position
    tilts = np.abs([estimated.roll_deg - flown.roll_deg, estimated.pitch_deg - flown.pitch_deg])
    turned = np.angle(np.exp(1j * (estimated_heading - heading)))
    return EstimateErrors(
        aside_m=np.hypot(away[:, 0], away[:, 1]),
        height_m=np.abs(away[:, 2]),
        velocity_m_s=np.linalg.norm(believed.velocity - path.velocity, axis=1),
        tilt_deg=tilts.max(axis=0),
        heading_deg=np.abs(np.degrees(turned)),
    )
