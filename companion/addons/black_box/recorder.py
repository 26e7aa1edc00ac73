"""Black box: the companion's images, decisions and setpoints in a file that survives a crash.

A thread samples telemetry, status and resources, records the pilot's decisions without delaying the
pilot, and syncs the file four times a second.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import psutil
from pydantic import TypeAdapter

from airl_mav.black_box import messages
from airl_mav.black_box.mcap_file import BlackBoxFile
from airl_mav.black_box.messages import encoded
from airl_mav.core import constants, errors, frames, machine
from airl_mav.core.clock import Clock, processor_time_us, utc_now, utc_us
from airl_mav.flight.episode_record import Setup
from airl_mav.latency.stamps import NO_STAMP
from airl_mav.policy.observation import Kinematics
from companion import link_interface, pilot

if TYPE_CHECKING:
    from airl_mav.scenario.stand_alone import StandAloneCompanion
    from companion.mavsdk_link import MavsdkLink
    from companion.program import MissionSetup

_SETUP = TypeAdapter(Setup)

SAMPLE_US = constants.US_PER_S // 25
"""Interval of telemetry samples [µs]; the flight controller sends 50 per second."""

STATUS_US = constants.US_PER_S // 2
"""Interval of status, battery and resources [µs]."""

SYNC_US = constants.US_PER_S // 4
"""Interval of syncs to disk [µs]; a crash loses at most this time plus one sample."""


class RecordedLink(Protocol):
    """Requirements of the black box on the link."""

    def kinematics(self) -> Kinematics:
        """Return the newest telemetry."""

    def status(self) -> link_interface.VehicleStatus:
        """Return armed state, flight mode and charge."""

    def battery(self) -> link_interface.BatteryState:
        """Return the newest state of the battery."""


class BlackBoxRecorder:
    """Recorder of a black box during a mission; a write error (`failure`) ends only the file."""

    def __init__(
        self,
        file: BlackBoxFile,
        link: RecordedLink,
        clock: Clock,
        goal: frames.Goal,
        images_hz: float,
    ) -> None:
        """Record to a new file, with at most `images_hz` images of decisions per second [Hz]."""
        self.failure: str | None = None
        """Reason for an early end of the file; None = no failure."""
        self._file, self._link, self._clock, self._goal = file, link, clock, goal
        # 0 disables images: they would be due at infinity.
        self._image_us = math.inf if images_hz == 0.0 else constants.US_PER_S / images_hz
        self._next_image_us = -math.inf
        self._unix_us = utc_us() - clock.time_us()
        """Calendar time at the clock's zero [µs since 1970], constant during the flight."""
        self._told: deque[pilot.SentDecision | tuple[messages.Message, int]] = deque()
        self._next_status_us = self._next_sync_us = 0
        self._process = psutil.Process()
        self._used_us, self._used_at_us = processor_time_us(), clock.time_us()
        psutil.cpu_percent()  # the first call only starts the measurement
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="black box", daemon=True)

    def start(self) -> None:
        """Start a thread that calls `record` at the sample interval."""
        self._thread.start()

    def decided(self, decided: pilot.SentDecision) -> None:
        """Queue a decision without blocking."""
        self._told.append(decided)

    def phase(self, phase: str) -> None:
        """Queue a phase that begins now."""
        now_us = self._clock.time_us()
        self._told.append((messages.Phase(now_us, phase), now_us))

    def heard(self, message: str) -> None:
        """Queue a text of the flight controller."""
        now_us = self._clock.time_us()
        said = messages.text(message, "flight controller", self._unix_us + now_us)
        self._told.append((said, now_us))

    def end(self, reason: str, notes: Sequence[str]) -> None:
        """Write the end of the mission and close the file."""
        self._stop()
        # The notes come after the last sample, and the end comes last.
        now_us = self._clock.time_us()
        for note in notes:
            said = messages.text(note, "companion", self._unix_us + now_us, messages.WARNING)
            self._told.append((said, now_us))
        self._told.append((messages.End(now_us, reason, tuple(notes)), now_us))
        self.record(now_us, last=True)

    def break_off(self) -> None:
        """Close the file without an end record, if still open."""
        self._stop()
        self._file.abandon()

    def _stop(self) -> None:
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        next_us = self._clock.time_us()
        while not self._ended.is_set() and self.failure is None:
            self.record(self._clock.time_us())
            # A late thread skips samples instead of catching up.
            next_us = max(next_us + SAMPLE_US, self._clock.time_us())
            self._clock.sleep_until(next_us, self._ended)

    def record(self, now_us: int, *, last: bool = False) -> None:
        """Write new data and a sample; `last` completes the file. No effect after a write error."""
        if self.failure is not None:
            return
        try:
            self._write_news(now_us)
            if last:
                self._file.finish()
        # A full disk ends the file, not the flight.
        except OSError as error:
            self.failure = f"the black box ends early: {self._file.path}: {error.strerror}"
            self._file.abandon()

    def _write_news(self, now_us: int) -> None:
        # popleft is atomic: the pilot's thread appends at the same time.
        while self._told:
            told = self._told.popleft()
            if isinstance(told, pilot.SentDecision):
                self._write_decision(told)
            else:
                self._write(*told)
        position, velocity, quaternion = _numbers(self._link.kinematics())
        self._write(messages.Telemetry(now_us, position, velocity, quaternion), now_us)
        if now_us >= self._next_status_us:
            self._next_status_us = now_us + STATUS_US
            self._write(self._status(now_us), now_us)
            self._write(self._resources(now_us), now_us)
        # fsync bounds what a power failure can lose.
        if now_us >= self._next_sync_us:
            self._next_sync_us = now_us + SYNC_US
            self._file.sync()

    def _write(self, message: messages.Message, now_us: int) -> None:
        self._file.write(message, self._unix_us + now_us)

    def _write_decision(self, told: pilot.SentDecision) -> None:
        frame = told.seen.frame
        age_us = told.started_us - frame.capture_time_us
        position, velocity, quaternion = _numbers(told.state)
        (away_m,) = _finite([frames.goal_distance_m(self._goal, told.state.position)])
        decision = messages.Decision(
            # Stamps of another clock do not give an image's age.
            frame.capture_time_us if 0 <= age_us <= pilot.OLDEST_FRAME_US else NO_STAMP,
            told.seen.received_us,
            told.started_us,
            told.ready_us,
            told.sent_us,
            told.held_until_us,
            told.held_before_us,
            *(position, velocity, quaternion),
            away_m,
            _finite(told.setpoint),
        )
        self._write(decision, told.sent_us)
        # Images are the bulk of the file, so their rate is limited separately.
        if told.started_us >= self._next_image_us:
            self._next_image_us = told.started_us + self._image_us
            seen_us = told.seen.received_us
            taken_us, sent_us = self._unix_us + seen_us, told.sent_us
            self._write(messages.image_message(frame.image, taken_us), sent_us)
            # Images of additional cameras have topics of their own, named after the camera.
            for name, each in frame.further.items():
                channel, data = encoded(messages.image_message(each.image, taken_us, name))
                channel = channel._replace(topic=f"{channel.topic}/{name}")
                self._file.add(channel, data, self._unix_us + sent_us)

    def _status(self, now_us: int) -> messages.Status:
        status, battery = self._link.status(), self._link.battery()
        return messages.Status(now_us, status.armed, status.offboard, status.mode, *battery)

    def _resources(self, now_us: int) -> messages.Resources:
        used_us, passed_us = processor_time_us() - self._used_us, now_us - self._used_at_us
        # Share of one processor since the last sample.
        self._used_us, self._used_at_us = self._used_us + used_us, now_us
        return messages.Resources(
            now_us,
            used_us / passed_us if passed_us > 0 else 0.0,
            psutil.cpu_percent(),
            self._process.memory_info().rss,
            machine.temperature_c(),
        )


def _numbers(state: Kinematics) -> Any:
    return tuple(map(_finite, (state.position, state.velocity, state.quaternion)))


def _finite(values: Iterable[float]) -> Any:
    return tuple(float(value) if math.isfinite(value) else None for value in values)


def run_of(asked: StandAloneCompanion, mission: MissionSetup) -> dict[str, Any]:
    """Return the setup and configuration in the format of `run.json`."""
    config = asked.model_dump(mode="json")
    config |= {"pilot": asdict(mission.pilot), "limits": mission.limits.model_dump(mode="json")}
    return {"setup": _SETUP.dump_python(mission.setup, mode="json"), "config": config}


def open_recorder(
    folder: Path,
    run: Mapping[str, Any],
    link: RecordedLink,
    clock: Clock,
    goal: frames.Goal,
) -> BlackBoxRecorder:
    """Return the recorder of a mission with a new file in a folder, or raise FieldError."""
    now = utc_now()
    made = {
        "name": "flight",
        "created_utc": now.isoformat(timespec="seconds"),
        "seeds": [run["config"]["seed"]],
        "versions": machine.package_versions(),
        "machine": machine.describe_machine(),
        "git": machine.git_state(),
    }
    try:
        # The file is created and synced before take-off: an unwritable folder must fail on the
        # ground.
        folder.mkdir(parents=True, exist_ok=True)
        file = BlackBoxFile(folder / f"{now:%Y%m%dT%H%M%S.%fZ}{messages.SUFFIX}", {**run, **made})
        file.sync()
    except OSError as error:
        raise errors.FieldError("black_box", f"{folder}", problem=f"{error.strerror}") from None
    return BlackBoxRecorder(file, link, clock, goal, run["config"]["black_box_images_hz"])


@contextmanager
def recorded(
    asked: StandAloneCompanion, mission: MissionSetup, link: MavsdkLink, clock: Clock
) -> Iterator[BlackBoxRecorder]:
    """Record a mission while the context is active. Raises FieldError if no file can be written."""
    run = run_of(asked, mission)
    recorder = open_recorder(Path(f"{asked.black_box}"), run, link, clock, mission.goal)
    recorder.start()
    try:
        link.hear_texts(recorder.heard)
        yield recorder
    finally:
        # After `end` the file is closed already, and this has no effect.
        recorder.break_off()
