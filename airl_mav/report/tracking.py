"""Command tracking of a flight: commanded, flown and estimated motion, as data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from airl_mav.core import constants, files, frames
from airl_mav.flight import episode_record, trajectory
from airl_mav.latency.stamps import ATTITUDE, NO_STAMP, RATES, SETPOINT, commanded, setpoint_column
from airl_mav.rehearsal.run_folder import MOTOR_OUTPUTS, MOTOR_TIMES, LoadedRun, flown_path

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TrackedMotion:
    """True or estimated motion of a vehicle at m times."""

    forward_m_s: Floats
    """Horizontal velocity (m,) along the heading."""
    right_m_s: Floats
    height_m: Floats
    """Height (m,) above the start."""
    yaw_rate_deg_s: Floats
    """Yaw rate (m,), clockwise from above, by differences of the heading between samples."""
    roll_deg: Floats
    pitch_deg: Floats
    heading_deg: Floats | None = None
    """Heading, -180 to 180; None here and below unless the commands include the quantity."""
    body_roll_rate_deg_s: Floats | None = None
    """Body rates about FRD axes, by differences between samples."""
    body_pitch_rate_deg_s: Floats | None = None
    body_yaw_rate_deg_s: Floats | None = None


COMMANDED: Mapping[str, tuple[str, ...]] = {
    SETPOINT: ("forward_m_s", "right_m_s", "", "yaw_rate_deg_s"),
    ATTITUDE: ("roll_deg", "pitch_deg", "heading_deg", "thrust"),
    RATES: ("body_roll_rate_deg_s", "body_pitch_rate_deg_s", "body_yaw_rate_deg_s", "thrust"),
}
"""Names of a setpoint's four numbers by its column: fields of `TrackedMotion`, and the thrust.
Numbers with an empty name are not shown. Values named _deg or _deg_s are recorded in rad."""


@dataclass(frozen=True)
class Commands:
    """Setpoints of n decisions; each holds until the next is sent."""

    sent_s: Floats
    """Send times (n,) since the start of navigation."""
    values: Mapping[str, Floats]
    """Values (n,) by name (`COMMANDED`). Velocities are in the heading frame, which may rotate
    during the hold."""


@dataclass(frozen=True)
class EstimateErrors:
    """Errors of the estimator at m times."""

    aside_m: Floats
    """Horizontal distance (m,) between estimated and true position."""
    height_m: Floats
    """Absolute height error (m,)."""
    velocity_m_s: Floats
    """Norm of the velocity error (m,)."""
    tilt_deg: Floats
    """Larger of the roll and pitch errors (m,)."""
    heading_deg: Floats


@dataclass(frozen=True)
class TrackedFlight:
    """Flight up to its verdict."""

    record: episode_record.EpisodeRecord
    time_s: Floats
    """Time (m,) since the start of navigation; negative before."""
    flown: TrackedMotion
    estimated: TrackedMotion | None
    """Estimated motion; None if not recorded."""
    errors: EstimateErrors | None
    commands: Commands
    altitude_m: float | None
    """Height setpoint [m]."""
    power_w: Floats | None
    """Electrical power (m,); None if not measured."""
    motors: Floats | None
    """Motor outputs (m, 4), 0 to 1, in PX4's order; None if not recorded."""


def track(run: LoadedRun, record: episode_record.EpisodeRecord) -> TrackedFlight | None:
    """Return commanded, flown and estimated motion of a flight; None without a path."""
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
    if (recorded := trajectory.estimate_of(stamps)) is not None and len(recorded) > 1:
        believed = recorded.at(path.time_us)
        estimated, estimated_heading = _motion(
            path.time_us, believed.position, believed.velocity, believed.quaternion
        )
        errors = _errors(path, flown, heading, believed, estimated, estimated_heading)
    return TrackedFlight(
        record=record,
        time_s=(path.time_us - record.zero_us) / constants.US_PER_S,
        flown=flown,
        estimated=estimated,
        errors=errors,
        commands=commands,
        # The height setpoint applies only to velocity commands.
        altitude_m=pilot.get("altitude_m") if commanded(stamps) == "velocity" else None,
        power_w=path.power_w if np.isfinite(path.power_w).all() else None,
        motors=_motors(stamps, path.time_us),
    )


def _motors(stamps: files.Arrays, time_us: NDArray[np.int64]) -> Floats | None:
    times, outputs = stamps.get(MOTOR_TIMES), stamps.get(MOTOR_OUTPUTS)
    if times is None or outputs is None or len(times) < 2:
        return None
    columns = [np.interp(time_us, times, column, left=0.0, right=0.0) for column in outputs.T]
    return np.stack(columns, axis=1)


def commands_of(stamps: files.Arrays, zero_us: int) -> Commands:
    """Return the sent setpoints with times relative to `zero_us`."""
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
    return Commands((sent[there] - zero_us) / constants.US_PER_S, values)


def _motion(
    time_us: NDArray[np.int64], position: Floats, velocity: Floats, quaternion: Floats
) -> tuple[TrackedMotion, Floats]:
    roll, pitch, yaw = frames.quats_to_euler(quaternion)
    heading: Floats = np.unwrap(yaw)
    level = frames.ned_to_heading(velocity, heading)
    rate = np.gradient(heading, time_us / constants.US_PER_S)
    motion = TrackedMotion(
        forward_m_s=level[:, 0],
        right_m_s=level[:, 1],
        height_m=-position[:, 2],
        yaw_rate_deg_s=np.degrees(rate),
        roll_deg=np.degrees(roll),
        pitch_deg=np.degrees(pitch),
    )
    return motion, heading


def _turned(path: trajectory.Trajectory) -> dict[str, Floats]:
    """Return the body rates (m,) [deg/s] by their names in `TrackedMotion`."""
    q = path.quaternion
    turn = frames.quat_multiply((q[:-1] * (1.0, -1.0, -1.0, -1.0)).T, q[1:].T).T
    sine = np.linalg.norm(turn[:, 1:], axis=1)
    # q and -q are the same attitude; take the shorter rotation.
    angle = 2.0 * np.arctan2(sine, np.abs(turn[:, 0])) * np.where(turn[:, 0] < 0.0, -1.0, 1.0)
    passed_s = np.diff(path.time_us) / constants.US_PER_S
    steps = turn[:, 1:] * (angle / np.maximum(sine, 1e-12) / passed_s)[:, None]
    # The steps are rates between samples; each sample gets the mean of both sides.
    sides = np.concatenate([steps[:1], steps, steps[-1:]])
    rates = np.degrees(0.5 * (sides[:-1] + sides[1:]))
    return dict(zip(COMMANDED[RATES], rates.T, strict=False))


def _errors(
    path: trajectory.Trajectory,
    flown: TrackedMotion,
    heading: Floats,
    believed: trajectory.Trajectory,
    estimated: TrackedMotion,
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
