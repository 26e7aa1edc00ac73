"""Messages of a flight, in an MCAP file."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from functools import cached_property
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from foxglove import messages
from numpy.typing import NDArray

from airl_mav.addons.export_log.recorded import RecordedFlight, charge_of, decision_messages
from airl_mav.addons.export_log.scene import (
    CAMERA,
    ESTIMATE,
    VEHICLE,
    WORLD,
    arena_scene,
    attitude,
    channel,
    movers_scene,
    path_scene,
    place,
    quaternion,
    timestamp,
    vector,
    vehicle_scene,
    velocity_scene,
)
from airl_mav.addons.recordings.recorded_flight import NAVIGATING
from airl_mav.addons.view import replayed_flight, view_messages
from airl_mav.black_box.mcap_file import McapFile
from airl_mav.black_box.messages import (
    INFO,
    WARNING,
    Channel,
    Command,
    End,
    Latency,
    Message,
    Phase,
    Status,
    Telemetry,
    Truth,
    encoded,
    text,
)
from airl_mav.core.clock import since_1970_us
from airl_mav.core.constants import US_PER_MS
from airl_mav.core.files import replacing
from airl_mav.core.frames import frd_to_flu, quat_flu_from_optical
from airl_mav.flight.trajectory import Trajectory, commanded_velocity
from airl_mav.latency.stages import stage_durations
from airl_mav.latency.stamps import NO_STAMP, SETPOINT
from airl_mav.profiles.projections import CameraKind
from airl_mav.rehearsal.run_folder import info_data
from airl_mav.report import policy_view, scene


def write_mcap(flight: RecordedFlight, path: Path) -> None:
    """Write a flight as MCAP, replacing an existing file."""
    messages = FlightMessages(flight)
    with replacing(path) as partial, partial.open("wb") as opened:
        file = McapFile(opened, run_of(flight))
        for message in messages:
            unix_us = messages.began_unix_us + message.time_us
            file.add(message.channel, message.data, unix_us)
        file.finish()


def run_of(flight: RecordedFlight) -> dict[str, Any]:
    """Return the run's description as in a black box, with the settings of this flight."""
    record, info = flight.replayed.record, flight.info
    config = info.config
    pilot, limits = dict(config.get("pilot") or {}), dict(config.get("limits") or {})
    pilot["goal_radius_m"] = record.goal_radius_m
    limits["flight_s"] = record.time_limit_s
    told = {
        "goal": list(record.goal),
        "seed": record.seed,
        "speed": config.get("speed") or info.setup.speed or 1.0,
        "pilot": pilot,
        "limits": limits,
    }
    return {**info_data(info), "config": {**config, **told}, "seeds": [record.seed]}


ENDED = "ended"
"""Phase after navigation."""

SAMPLES_A_SCENE = 5
"""Path samples per scene message: 10 Hz."""

SAMPLES_A_STATUS = 25
"""Path samples per status message: 2 Hz, as in a black box."""

REFEREE = "referee"

IMAGES: dict[CameraKind, tuple[str, str]] = {
    "depth": ("16UC1", "/camera/depth"),
    "rgb": ("rgb8", "/camera/image"),
    "grey": ("mono8", "/camera/image"),
}
"""Encoding and topic of a camera's images."""


class Told(NamedTuple):
    """Encoded message for a file or a server."""

    time_us: int
    channel: Channel
    data: bytes


class FlightMessages:
    """Messages of a flight in order of time."""

    def __init__(self, flight: RecordedFlight) -> None:
        """Store a flight and its creation time."""
        self.flight = flight
        self._replayed = flight.replayed
        self._record = flight.replayed.record
        self._path = flight.replayed.path
        self.began_unix_us = since_1970_us(flight.info.created_utc)
        """Calendar time of simulated time 0 [µs since 1970]: the run's creation."""

    def __iter__(self) -> Iterator[Told]:
        """Yield the messages."""
        parts = [self._still(), self._moving(), self._seen(), self._decided(), self._said()]
        parts += [self._state(), self._commanded()]
        return heapq.merge(*parts, key=itemgetter(0))

    def _unix_us(self, time_us: int) -> int:
        return self.began_unix_us + time_us

    def _ours(self, time_us: int, message: Message) -> Told:
        return Told(time_us, *encoded(message))

    def _drawn(self, time_us: int, topic: str, message: Any) -> Told:
        return Told(time_us, channel(topic, message), message.encode())

    @cached_property
    def _shape(self) -> view_messages.VehicleShape:
        return view_messages.VehicleShape.of(self._replayed.vehicle)

    @cached_property
    def _camera(self) -> policy_view.PolicyCamera:
        return policy_view.PolicyCamera.of(self._replayed.vehicle.camera)

    # --- 3D scene

    def _still(self) -> Iterator[Told]:
        record, time_us = self._record, int(self._path.time_us[0])
        at = timestamp(self._unix_us(time_us))
        arena = arena_scene(self._replayed.arena, record.goal, record.goal_radius_m, at)
        way = path_scene(np.array(self._replayed.trail), at)
        yield self._drawn(time_us, "/scene/arena", arena)
        yield self._drawn(time_us, "/scene/path", way)
        yield self._drawn(time_us, "/scene/vehicle", self._vehicle(VEHICLE, time_us))
        if self.flight.estimate is not None:
            yield self._drawn(time_us, "/scene/estimate", self._vehicle(ESTIMATE, time_us))
        if self._camera.intrinsics.model.calibration is not None:
            yield self._drawn(time_us, "/camera/calibration", self._calibration(time_us))

    def _vehicle(self, frame: str, time_us: int) -> messages.SceneUpdate:
        look = scene.FIRST if frame == VEHICLE else scene.OTHER
        return vehicle_scene(self._shape, frame, look, timestamp(self._unix_us(time_us)))

    def _moving(self) -> Iterator[Told]:
        path, estimate = self._path, self.flight.estimate
        parts = [self._poses(path, "/tf", VEHICLE), self._scene(path)]
        if estimate is not None:
            parts.append(self._poses(estimate, "/tf_estimate", ESTIMATE))
        return heapq.merge(*parts, key=itemgetter(0))

    def _poses(self, path: Trajectory, topic: str, frame: str) -> Iterator[Told]:
        mount = self._camera.mount
        for i, time_us in enumerate(path.time_us.tolist()):
            at = timestamp(self._unix_us(time_us))
            transforms = [
                messages.FrameTransform(
                    timestamp=at,
                    parent_frame_id=WORLD,
                    child_frame_id=frame,
                    translation=place(path.position[i]),
                    rotation=attitude(path.quaternion[i]),
                )
            ]
            if frame == VEHICLE:
                # Repeated with every vehicle pose: seeking viewers load only the newest message.
                transforms.append(
                    messages.FrameTransform(
                        timestamp=at,
                        parent_frame_id=VEHICLE,
                        child_frame_id=CAMERA,
                        translation=vector(frd_to_flu(np.array(mount.offset))),
                        rotation=quaternion(quat_flu_from_optical(mount.pitch_up, mount.yaw)),
                    )
                )
            yield self._drawn(time_us, topic, messages.FrameTransforms(transforms=transforms))

    def _scene(self, path: Trajectory) -> Iterator[Told]:
        arena, commanded = self._replayed.arena, self._commands(path.time_us)
        for i in range(0, len(path), SAMPLES_A_SCENE):
            time_us = int(path.time_us[i])
            at = timestamp(self._unix_us(time_us))
            command = commanded[i] if self._record.navigates(time_us) else None
            arrows = velocity_scene(path.position[i], path.velocity[i], command, at)
            yield self._drawn(time_us, "/scene/velocity", arrows)
            if arena is not None and arena.tours:
                moved = movers_scene(arena, time_us - self._record.started_us, at)
                yield self._drawn(time_us, "/scene/movers", moved)

    # --- the camera

    def _calibration(self, time_us: int) -> messages.CameraCalibration:
        k = self._camera.intrinsics
        f, cx, cy = k.focal, k.cx, k.cy
        return messages.CameraCalibration(
            timestamp=timestamp(self._unix_us(time_us)),
            frame_id=CAMERA,
            width=k.width,
            height=k.height,
            distortion_model=k.model.calibration or "",
            D=list(k.distortion) if k.model.calibration else [],
            K=[f, 0.0, cx, 0.0, f, cy, 0.0, 0.0, 1.0],
            R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            P=[f, 0.0, cx, 0.0, 0.0, f, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        )

    def _seen(self) -> Iterator[Told]:
        columns = self.flight.decisions
        for time_us in np.unique(columns.get("capture_us", np.zeros(0, np.int64))).tolist():
            seen = None if time_us == NO_STAMP else self._replayed.image(time_us)
            if seen is None:
                continue
            height, width = seen.shape[:2]
            encoding, topic = IMAGES[self._camera.intrinsics.kind]
            image = messages.RawImage(
                timestamp=timestamp(self._unix_us(time_us)),
                frame_id=CAMERA,
                width=width,
                height=height,
                encoding=encoding,
                step=seen.nbytes // height,
                data=np.ascontiguousarray(seen, seen.dtype.newbyteorder("<")).tobytes(),
            )
            yield self._drawn(time_us, topic, image)

    # --- numbers and texts, as in a black box

    def _state(self) -> Iterator[Told]:
        telemetry = (self._ours(row[0], Telemetry(*row)) for row in _rows(self.flight.believed))
        parts: list[Iterable[Told]] = [telemetry, self._status()]
        if (truth := self.flight.truth) is not None:
            rows = zip(_rows(truth), truth.power_w.tolist(), strict=True)
            parts.append(self._ours(row[0], Truth(*row, watts)) for row, watts in rows)
        return heapq.merge(*parts, key=itemgetter(0))

    def _status(self) -> Iterator[Told]:
        charge = charge_of(self.flight)
        for i in range(0, len(self._path), SAMPLES_A_STATUS):
            time_us = int(self._path.time_us[i])
            navigates = self._record.navigates(time_us)
            flies = navigates or -float(self._path.position[i, 2]) > replayed_flight.STANDING_M
            battery = (
                (None, None, None)
                if charge is None
                else (charge.voltage_v[i], charge.current_a[i], charge.remaining[i])
            )
            mode = view_messages.OFFBOARD if navigates else ""
            yield self._ours(time_us, Status(time_us, flies, navigates, mode, *battery))

    def _commands(self, times_us: NDArray[np.int64]) -> NDArray[np.float64]:
        return commanded_velocity(self._path, self.flight.decisions, times_us)

    def _commanded(self) -> Iterator[Told]:
        columns = self.flight.decisions
        if not len(columns.get(SETPOINT, ())):
            return  # The policy commands no velocity.
        velocities = self._commands(self._path.time_us)
        which = np.searchsorted(columns["sent_us"], self._path.time_us, side="right") - 1
        rates = np.where(which < 0, 0.0, columns[SETPOINT][np.maximum(which, 0), 3])
        for i, time_us in enumerate(self._path.time_us.tolist()):
            if self._record.navigates(time_us):
                command = Command(time_us, tuple(velocities[i].tolist()), float(rates[i]))
                yield self._ours(time_us, command)

    def _decided(self) -> Iterator[Told]:
        columns = self.flight.decisions
        stages = stage_durations(columns)
        for i, decision in enumerate(decision_messages(self.flight)):
            took_ms = {
                f"{key}_ms": _of_row(i, *stages[key], scale=1.0 / US_PER_MS)
                for key in ("t1", "wait", "t2", "send", "link", "control", "end_to_end", "t3")
            }
            period_ms = _of_row(i, *stages["period"], scale=1.0 / US_PER_MS)
            sent_us = decision.sent_us
            yield self._ours(sent_us, decision)
            yield self._ours(sent_us, Latency(sent_us, **took_ms, period_ms=period_ms))

    def _said(self) -> Iterator[Told]:
        record, last_us = self._record, int(self._path.time_us[-1])
        first_us = int(self._path.time_us[0])
        found: list[Told] = []

        def say(time_us: int, words: str, who: str, level: int) -> None:
            found.append(self._ours(time_us, text(words, who, self._unix_us(time_us), level)))

        say(first_us, f"seed {record.seed}, arena {record.arena or 'none'}", "run", INFO)
        for note in (*record.notes, *record.invalid):
            say(first_us, note, "notes", WARNING)
        for fault in record.faults:
            say(fault.from_us, f"begins: {fault.fault}", "faults", WARNING)
            say(fault.to_us, f"ends: {fault.fault}", "faults", INFO)
        how = f"{record.outcome.value}: {record.reason}"
        say(record.ended_us, how, REFEREE, INFO)
        if record.navigation_us is not None:
            found.append(self._ours(record.navigation_us, Phase(record.navigation_us, NAVIGATING)))
        found.append(self._ours(record.ended_us, Phase(record.ended_us, ENDED)))
        end_us = max(last_us, record.ended_us)
        found.append(self._ours(end_us, End(end_us, record.reason, record.notes)))
        return iter(sorted(found, key=itemgetter(0)))


def _rows(path: Trajectory) -> Iterator[tuple[int, Any, Any, Any]]:
    states = (path.position.tolist(), path.velocity.tolist(), path.quaternion.tolist())
    for time_us, position, velocity, quat in zip(path.time_us.tolist(), *states, strict=True):
        yield time_us, tuple(position), tuple(velocity), tuple(quat)


def _of_row(
    i: int, rows: NDArray[np.int64], values: NDArray[np.int64], *, scale: float
) -> float | None:
    at = int(np.searchsorted(rows, i))
    return float(values[at]) * scale if at < len(rows) and rows[at] == i else None
