"""How a flight followed its commands: commanded, flown and estimated motion on one time axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_S
from airl_mav.core.files import Arrays
from airl_mav.core.frames import ned_to_heading, quat_multiply, quats_to_euler
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.trajectory import Trajectory
from airl_mav.latency.stamps import ATTITUDE, NO_STAMP, RATES, SETPOINT, commanded, setpoint_column
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
    heading_deg: Floats | None = None
    """-180 to 180; this and the following only of a flight that is commanded by them."""
    body_roll_rate_deg_s: Floats | None = None
    """About the body's axes FRD, from sample to sample."""
    body_pitch_rate_deg_s: Floats | None = None
    body_yaw_rate_deg_s: Floats | None = None


COMMANDED: Mapping[str, tuple[str, ...]] = {
    SETPOINT: ("forward_m_s", "right_m_s", "", "yaw_rate_deg_s"),
    ATTITUDE: ("roll_deg", "pitch_deg", "heading_deg", "thrust"),
    RATES: ("body_roll_rate_deg_s", "body_pitch_rate_deg_s", "body_yaw_rate_deg_s", "thrust"),
}
"""The four numbers of a setpoint by the column that they stand in. Named as the fields of `Motion`,
and the thrust; what has no name is not shown. What ends with _deg or _deg_s is recorded in rad."""


@dataclass(frozen=True)
class Commands:
    """The setpoints of n decisions; each holds until the next one is sent."""

    sent_s: Floats
    """(n,) since the start of navigation."""
    values: Mapping[str, Floats]
    """(n,) each, by name (`COMMANDED`); velocities are along the heading, which the vehicle may
    turn meanwhile."""


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
    power_w: Floats | None
    """None: nobody measured it."""
    motors: Floats | None
    """(m, 4) motor outputs 0 to 1, in PX4's order; None: not recorded."""


def track(run: LoadedRun, record: EpisodeRecord) -> TrackedFlight | None:
    """Return how a flight followed its commands; None where no path of it is recorded."""
    path = flown_path(run, record)
    if path is None or len(path) < 2:
        return None
    stamps = run.latency.get(record.index, {})
    flown, heading = _motion(path.time_us, path.position, path.velocity, path.quaternion)
    commands, pilot = commands_of(stamps, record.zero_us), run.info.config.get("pilot", {})
    if "heading_deg" in commands.values:
        flown = replace(flown, heading_deg=np.degrees(np.angle(np.exp(1j * heading))))
    elif "body_roll_rate_deg_s" in commands.values:
        flown = replace(flown, **_turned(path))
    estimated = errors = None
    if len(stamps.get("estimate/time_us", ())) > 1:
        believed = _at(stamps, path.time_us)
        estimated, estimated_heading = _motion(
            path.time_us, believed.position, believed.velocity, believed.quaternion
        )
        errors = _errors(path, flown, heading, believed, estimated, estimated_heading)
    return TrackedFlight(
        record=record,
        time_s=(path.time_us - record.zero_us) / US_PER_S,
        flown=flown,
        estimated=estimated,
        errors=errors,
        commands=commands,
        # Who commands no velocity holds a height of its own.
        altitude_m=pilot.get("altitude_m") if commanded(stamps) == "velocity" else None,
        power_w=path.power_w if np.isfinite(path.power_w).all() else None,
        motors=_motors(stamps, path.time_us),
    )


def _motors(stamps: Arrays, time_us: NDArray[np.int64]) -> Floats | None:
    times, outputs = stamps.get(MOTOR_TIMES), stamps.get(MOTOR_OUTPUTS)
    if times is None or outputs is None or len(times) < 2:
        return None
    columns = [np.interp(time_us, times, column, left=0.0, right=0.0) for column in outputs.T]
    return np.stack(columns, axis=1)


def commands_of(stamps: Arrays, zero_us: int) -> Commands:
    """Return the setpoints that were sent, as time counts from `zero_us`."""
    sent = np.asarray(stamps.get("sent_us", np.zeros(0)), np.int64)
    column = setpoint_column(stamps) or SETPOINT
    setpoint = np.asarray(stamps.get(column, np.zeros((len(sent), 4))), np.float64)
    there = sent != NO_STAMP
    numbers = setpoint[there].T if there.any() else np.zeros((4, 0))
    values = {
        name: np.degrees(row) if name.endswith(("_deg", "_deg_s")) else row
        for name, row in zip(COMMANDED[column], numbers, strict=True)
        if name
    }
    return Commands((sent[there] - zero_us) / US_PER_S, values)


def _motion(
    time_us: NDArray[np.int64], position: Floats, velocity: Floats, quaternion: Floats
) -> tuple[Motion, Floats]:
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


def _turned(path: Trajectory) -> dict[str, Floats]:
    """Return the body rates (m,) [deg/s], by their names in `Motion`."""
    q = path.quaternion
    turn = quat_multiply((q[:-1] * (1.0, -1.0, -1.0, -1.0)).T, q[1:].T).T
    sine = np.linalg.norm(turn[:, 1:], axis=1)
    # q and -q are the same attitude: by the shorter way.
    angle = 2.0 * np.arctan2(sine, np.abs(turn[:, 0])) * np.where(turn[:, 0] < 0.0, -1.0, 1.0)
    passed_s = np.diff(path.time_us) / US_PER_S
    steps = turn[:, 1:] * (angle / np.maximum(sine, 1e-12) / passed_s)[:, None]
    # Between two samples; at a sample the mean of both sides.
    sides = np.concatenate([steps[:1], steps, steps[-1:]])
    rates = np.degrees(0.5 * (sides[:-1] + sides[1:]))
    return dict(zip(COMMANDED[RATES], rates.T, strict=False))


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
