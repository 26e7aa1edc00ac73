"""Export of flights to ULog with the topics of `flight_log.topics`; unknown fields are NaN or 0."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.export_log.recorded import RecordedFlight, charge_of
from airl_mav.addons.view.replayed_flight import INFO, STANDING_M, WARNING
from airl_mav.core.frames import quat_from_euler, quats_to_euler
from airl_mav.flight.trajectory import Trajectory, commanded_velocity
from airl_mav.latency.stamps import ATTITUDE, RATES, SETPOINT
from airl_mav.profiles.px4_release import px4_release
from firmware_sim.addons.flight_log.flight_log import described
from firmware_sim.addons.flight_log.topics import ARMED, DISARMED, TOPICS
from firmware_sim.addons.flight_log.ulog_writer import UlogWriter
from firmware_sim.autopilot.flight_modes import Mode

_LOGGED = {logged.topic.name: logged for logged in TOPICS}

NAMES = (
    "vehicle_attitude",
    "vehicle_attitude_groundtruth",
    "vehicle_local_position",
    "vehicle_local_position_groundtruth",
    "vehicle_local_position_setpoint",
    "trajectory_setpoint",
    "vehicle_attitude_setpoint",
    "vehicle_rates_setpoint",
    "battery_status",
    "vehicle_status",
    "actuator_armed",
    "vehicle_land_detected",
)

_NUMBER = {name: i for i, name in enumerate(NAMES)}

Samples = tuple[str, NDArray[Any], Mapping[str, Any]]
"""Topic, times (n,) [µs], and values (n, ...) by field; the others are blank."""


def write_ulog(flight: RecordedFlight, path: Path) -> None:
    """Write a flight as ULog; times are shifted if the path starts before time 0."""
    began_us = int(flight.replayed.path.time_us[0])
    later_us = max(0, -began_us)
    exported = [_LOGGED[name].topic for name in NAMES]
    info = ("sys_name", "airl-mav export-log"), *described(px4_release().flight_sw_version)
    writer = UlogWriter(path, began_us + later_us, exported, info, ())
    try:
        for name, times_us, columns in samples(flight):
            topic, shifted = _LOGGED[name].topic, times_us + later_us
            sampled = "uint64_t timestamp_sample" in topic.fields
            known = {**columns, "timestamp_sample": shifted} if sampled else columns
            writer.samples(_NUMBER[name], topic.rows(shifted, known))
        for time_us, severity, words in sorted(_texts(flight), key=itemgetter(0)):
            writer.text(time_us + later_us, severity, words)
        writer.flush()
        if writer.failure is not None:
            raise OSError(writer.failure.errno, writer.failure.strerror, str(path))
        writer.close()
    except BaseException:
        writer.discard()
        raise


def samples(flight: RecordedFlight) -> Iterator[Samples]:
    """Yield the samples to be logged, topic by topic."""
    path, truth = flight.replayed.path, flight.truth
    yield from _motion(flight.believed, "")
    if truth is not None:
        yield from _motion(truth, "_groundtruth")
    yield from _setpoints(flight)
    yield from _battery(flight)
    yield from _states(flight, path)


def _every(path: Trajectory, topic: str) -> list[int]:
    """Return the row numbers of path samples at least the interval of a topic apart."""
    kept, due_us = [], int(path.time_us[0])
    for i, time_us in enumerate(path.time_us.tolist()):
        if time_us >= due_us:
            kept.append(i)
            due_us = time_us + _LOGGED[topic].interval_us
    return kept


def _motion(path: Trajectory, suffix: str) -> Iterator[Samples]:
    """Yield attitude, position and velocity, NED; `suffix` is appended to the topic names."""
    attitude, position = f"vehicle_attitude{suffix}", f"vehicle_local_position{suffix}"
    kept = _every(path, attitude)
    yield attitude, path.time_us[kept], {"q": path.quaternion[kept]}
    kept = _every(path, position)
    columns = np.column_stack([path.position[kept], path.velocity[kept]]).T
    known = dict(zip(("x", "y", "z", "vx", "vy", "vz"), columns, strict=True))
    known["z_deriv"], known["heading"] = columns[5], quats_to_euler(path.quaternion[kept])[2]
    valid = dict.fromkeys(("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"), True)
    yield position, path.time_us[kept], {**known, **valid}


def _setpoints(flight: RecordedFlight) -> Iterator[Samples]:
    columns = flight.decisions
    if len(columns.get(SETPOINT, ())):
        yield from _velocity_setpoints(flight, columns)
    for name, column in (
        ("vehicle_attitude_setpoint", ATTITUDE),
        ("vehicle_rates_setpoint", RATES),
    ):
        if not len(columns.get(column, ())):
            continue
        times_us, newest = _commanded(flight, name)
        *angles, thrust = columns[column][newest].astype(float).T
        known: dict[str, Any] = dict(zip(("roll", "pitch", "yaw"), angles, strict=True))
        if column == ATTITUDE:
            turns = [quat_from_euler(*each) for each in zip(*angles, strict=True)]
            known = {"q_d": np.reshape(turns, (-1, 4))}
        yield name, times_us, {**known, "thrust_body": np.outer(thrust, (0.0, 0.0, -1.0))}


def _velocity_setpoints(
    flight: RecordedFlight, columns: Mapping[str, NDArray[Any]]
) -> Iterator[Samples]:
    path = flight.replayed.path
    velocities = commanded_velocity(path, columns, path.time_us)
    for name in ("vehicle_local_position_setpoint", "trajectory_setpoint"):
        times_us, newest = _commanded(flight, name)
        velocity = velocities[np.searchsorted(path.time_us, times_us)]
        values = dict(zip(("vx", "vy", "vz"), velocity.T, strict=True))
        if name == "trajectory_setpoint":
            values = {"velocity": velocity}
        yield name, times_us, {**values, "yawspeed": columns[SETPOINT][newest, 3]}


def _commanded(flight: RecordedFlight, topic: str) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return path times [µs] during navigation with the numbers of the newest decisions."""
    path = flight.replayed.path
    times_us = path.time_us[_every(path, topic)]
    newest = np.searchsorted(flight.decisions["sent_us"], times_us, side="right") - 1
    navigates = [flight.replayed.record.navigates(each) for each in times_us.tolist()]
    known = (newest >= 0) & np.array(navigates, bool)
    return times_us[known], newest[known]


def _battery(flight: RecordedFlight) -> Iterator[Samples]:
    charge, path, name = charge_of(flight), flight.replayed.path, "battery_status"
    if charge is not None:
        kept = _every(path, name)
        yield name, path.time_us[kept], {key: each[kept] for key, each in vars(charge).items()}


def _states(flight: RecordedFlight, path: Trajectory) -> Iterator[Samples]:
    """Yield mode, arming and landed state on every change and every half second."""
    last, due_us, rows = None, 0, []
    for time_us, position in zip(path.time_us.tolist(), path.position, strict=True):
        navigates = flight.replayed.record.navigates(time_us)
        flies = navigates or -float(position[2]) > STANDING_M
        if (navigates, flies) == last and time_us < due_us:
            continue
        last, due_us = (navigates, flies), time_us + _LOGGED["vehicle_status"].interval_us
        rows.append((time_us, navigates, flies))
    times_us, navigating, flying = np.array(rows, np.int64).reshape(-1, 3).T
    mode = np.where(navigating, Mode.OFFBOARD.spec.state, Mode.HOLD.spec.state)
    status = {"nav_state_user_intention": mode, "nav_state": mode, "pre_flight_checks_pass": True}
    status["arming_state"] = np.where(flying, ARMED, DISARMED)
    landed = dict.fromkeys(("ground_contact", "maybe_landed", "landed"), 1 - flying)
    yield "vehicle_status", times_us, status
    yield "actuator_armed", times_us, {"armed": flying, "ready_to_arm": True}
    yield "vehicle_land_detected", times_us, landed


def _texts(flight: RecordedFlight) -> Iterator[tuple[int, int, str]]:
    record = flight.replayed.record
    for note in (*record.notes, *record.invalid):
        yield int(flight.replayed.path.time_us[0]), WARNING, note
    for fault in record.faults:
        yield fault.from_us, WARNING, f"begins: {fault.fault}"
    yield record.ended_us, INFO, f"{record.outcome.value}: {record.reason}"
