"""Export of flights to ULog with the topics of `flight_log.topics`; unknown fields are NaN or 0."""

from __future__ import annotations

import math
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
from firmware_sim.addons.flight_log.topics import ARMED, DISARMED, ON_CHANGE_US, ROTARY_WING, TOPICS
from firmware_sim.addons.flight_log.ulog_writer import Topic, UlogWriter, Values
from firmware_sim.autopilot.flight_modes import Mode

_LOGGED = {logged.topic.name: logged for logged in TOPICS}

TRAJECTORY_SETPOINT = Topic(
    "trajectory_setpoint",
    (
        *("float[3] position", "float[3] velocity", "float[3] acceleration", "float[3] jerk"),
        *("float yaw", "float yawspeed"),
    ),
)
"""Setpoint of the companion; PX4 logs it every 200 ms."""

SETPOINT_US = 200_000

NAMES = (
    "vehicle_attitude",
    "vehicle_attitude_groundtruth",
    "vehicle_local_position",
    "vehicle_local_position_groundtruth",
    "vehicle_local_position_setpoint",
    "vehicle_attitude_setpoint",
    "vehicle_rates_setpoint",
    "battery_status",
    "vehicle_status",
    "actuator_armed",
    "vehicle_land_detected",
)

EXPORTED = (*(_LOGGED[name].topic for name in NAMES), TRAJECTORY_SETPOINT)

_NUMBER = {topic.name: i for i, topic in enumerate(EXPORTED)}

Sample = tuple[int, str, Values]


def write_ulog(flight: RecordedFlight, path: Path) -> None:
    """Write a flight as ULog; times are shifted if the path starts before time 0."""
    began_us = int(flight.replayed.path.time_us[0])
    later_us = max(0, -began_us)
    facts = (("sys_name", "airl-mav export-log"), *described(px4_release().flight_sw_version))
    writer = UlogWriter(path, began_us + later_us, EXPORTED, facts, ())
    try:
        texts = [(time_us, "", (severity, words)) for time_us, severity, words in _texts(flight)]
        rows: list[tuple[int, str, Any]] = [*samples(flight), *texts]
        for time_us, name, values in sorted(rows, key=itemgetter(0)):
            if name:
                writer.sample(_NUMBER[name], time_us + later_us, _later(name, values, later_us))
            else:
                writer.text(time_us + later_us, *values)
        writer.flush()
        if writer.failure is not None:
            raise OSError(writer.failure.errno, writer.failure.strerror, str(path))
        writer.close()
    except BaseException:
        writer.discard()
        raise


def _later(topic: str, values: Values, later_us: int) -> Values:
    """Return a topic's values with its `timestamp_sample`, if any, shifted by `later_us` [µs]."""
    if not later_us or "uint64_t timestamp_sample" not in EXPORTED[_NUMBER[topic]].fields[:1]:
        return values
    return (values[0] + later_us, *values[1:])


def samples(flight: RecordedFlight) -> Iterator[Sample]:
    """Yield the samples to be logged, topic by topic."""
    path, truth = flight.replayed.path, flight.truth
    yield from _motion(flight.believed, "")
    if truth is not None:
        yield from _motion(truth, "_groundtruth")
    yield from _setpoints(flight)
    yield from _battery(flight)
    yield from _states(flight, path)


def row(topic: str, **known: Any) -> Values:
    """Return a topic's field values with defaults for missing ones; check names and lengths."""
    values: list[float | int | bool] = []
    for field in EXPORTED[_NUMBER[topic]].fields:
        kind, name = field.split()
        base, _, count = kind.rstrip("]").partition("[")
        length = int(count or 1)
        unknown = math.nan if base in ("float", "double") else False if base == "bool" else 0
        given = known.pop(name, [unknown] * length)
        part = np.atleast_1d(given).tolist()
        if len(part) != length:
            raise ValueError(f"{topic}.{name}: {len(part)} values, not {length}")
        values += part
    if known:
        raise KeyError(f"{topic}: {', '.join(known)}")
    return tuple(values)


def _every(path: Trajectory, interval_us: int) -> list[int]:
    """Return the row numbers of path samples at least `interval_us` apart [µs]."""
    kept, due_us = [], int(path.time_us[0])
    for i, time_us in enumerate(path.time_us.tolist()):
        if time_us >= due_us:
            kept.append(i)
            due_us = time_us + interval_us
    return kept


def _motion(path: Trajectory, suffix: str) -> Iterator[Sample]:
    """Yield attitude, position and velocity, NED; `suffix` is appended to the topic names."""
    attitude, position = f"vehicle_attitude{suffix}", f"vehicle_local_position{suffix}"
    for i in _every(path, _LOGGED[attitude].interval_us):
        time_us = int(path.time_us[i])
        yield time_us, attitude, row(attitude, timestamp_sample=time_us, q=path.quaternion[i])
    headings = quats_to_euler(path.quaternion)[2]
    valid = dict.fromkeys(("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"), True)
    for i in _every(path, _LOGGED[position].interval_us):
        time_us = int(path.time_us[i])
        places = dict(zip(("x", "y", "z"), path.position[i].tolist(), strict=True))
        speeds = dict(zip(("vx", "vy", "vz"), path.velocity[i].tolist(), strict=True))
        known = {**places, **speeds, "z_deriv": speeds["vz"], "heading": headings[i], **valid}
        yield time_us, position, row(position, timestamp_sample=time_us, **known)


def _setpoints(flight: RecordedFlight) -> Iterator[Sample]:
    columns = flight.decisions
    if len(columns.get(SETPOINT, ())):
        yield from _velocity_setpoints(flight, columns)
    if len(columns.get(ATTITUDE, ())):
        name = "vehicle_attitude_setpoint"
        for time_us, newest in _commanded(flight, _LOGGED[name].interval_us):
            *angles, thrust = columns[ATTITUDE][newest].tolist()
            q_d = quat_from_euler(*angles)
            yield time_us, name, row(name, q_d=q_d, thrust_body=(0.0, 0.0, -thrust))
    if len(columns.get(RATES, ())):
        name = "vehicle_rates_setpoint"
        for time_us, newest in _commanded(flight, _LOGGED[name].interval_us):
            *rates, thrust = columns[RATES][newest].tolist()
            turns = dict(zip(("roll", "pitch", "yaw"), rates, strict=True))
            yield time_us, name, row(name, **turns, thrust_body=(0.0, 0.0, -thrust))


def _velocity_setpoints(
    flight: RecordedFlight, columns: Mapping[str, NDArray[Any]]
) -> Iterator[Sample]:
    path = flight.replayed.path
    velocities = commanded_velocity(path, columns, path.time_us)
    tracked, commanded = "vehicle_local_position_setpoint", TRAJECTORY_SETPOINT.name
    for name, interval_us in ((tracked, _LOGGED[tracked].interval_us), (commanded, SETPOINT_US)):
        for time_us, newest in _commanded(flight, interval_us):
            velocity = velocities[np.searchsorted(path.time_us, time_us)].tolist()
            speeds = dict(zip(("vx", "vy", "vz"), velocity, strict=True))
            values = speeds if name == tracked else {"velocity": velocity}
            turn = float(columns[SETPOINT][newest, 3])
            yield time_us, name, row(name, **values, yawspeed=turn)


def _commanded(flight: RecordedFlight, interval_us: int) -> Iterator[tuple[int, int]]:
    """Yield path times [µs] during navigation with the number of the newest decision."""
    path = flight.replayed.path
    which = np.searchsorted(flight.decisions["sent_us"], path.time_us, side="right") - 1
    for i in _every(path, interval_us):
        time_us = int(path.time_us[i])
        if which[i] >= 0 and flight.replayed.record.navigates(time_us):
            yield time_us, int(which[i])


def _battery(flight: RecordedFlight) -> Iterator[Sample]:
    charge, path, name = charge_of(flight), flight.replayed.path, "battery_status"
    if charge is None:
        return
    for i in _every(path, _LOGGED[name].interval_us):
        values = row(
            name,
            voltage_v=charge.voltage_v[i],
            current_a=charge.current_a[i],
            discharged_mah=charge.discharged_mah[i],
            remaining=charge.remaining[i],
            scale=1.0,
            connected=True,
            id=1,
        )
        yield int(path.time_us[i]), name, values


def _states(flight: RecordedFlight, path: Trajectory) -> Iterator[Sample]:
    """Yield mode, arming and landed state on every change and every half second."""
    last, due_us = None, 0
    for time_us, position in zip(path.time_us.tolist(), path.position, strict=True):
        navigates = flight.replayed.record.navigates(time_us)
        flies = navigates or -float(position[2]) > STANDING_M
        if (navigates, flies) == last and time_us < due_us:
            continue
        last, due_us = (navigates, flies), time_us + ON_CHANGE_US
        mode = (Mode.OFFBOARD if navigates else Mode.HOLD).spec.state
        status = row(
            "vehicle_status",
            arming_state=ARMED if flies else DISARMED,
            nav_state_user_intention=mode,
            nav_state=mode,
            vehicle_type=ROTARY_WING,
            pre_flight_checks_pass=True,
        )
        landed = dict.fromkeys(("ground_contact", "maybe_landed", "landed"), not flies)
        yield time_us, "vehicle_status", status
        yield time_us, "actuator_armed", row("actuator_armed", armed=flies, ready_to_arm=True)
        yield time_us, "vehicle_land_detected", row("vehicle_land_detected", **landed)


def _texts(flight: RecordedFlight) -> Iterator[tuple[int, int, str]]:
    record = flight.replayed.record
    for note in (*record.notes, *record.invalid):
        yield int(flight.replayed.path.time_us[0]), WARNING, note
    for fault in record.faults:
        yield fault.from_us, WARNING, f"begins: {fault.fault}"
    yield record.ended_us, INFO, f"{record.outcome.value}: {record.reason}"
