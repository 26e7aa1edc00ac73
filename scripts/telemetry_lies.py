"""False telemetry and frames in every phase of a flight: found after how long, flown how far.

    python scripts/telemetry_lies.py [--seeds 5] [--lies WORD...] [--out DIR]

A deterministic man in the middle changes MAVLink messages and frames between vehicle and companion
in lockstep, from a moment of each phase on. Each flight is compared with the honest flight of its
seed: both are equal up to that moment. No referee ends them. Every flight is a line of flights.csv
in --out, and the same command resumes from there. Writes table.json, which results.py publishes.

A lie that moves the vehicle more than 2 m off the honest path must be found within 2 s, or stand
in UNDETECTABLE with its reason. Exit status 0: all do.
"""

# ruff: noqa: ARG001, ARG005 (every lie has the signature of `Change`)
from __future__ import annotations

import math
import re
import shlex
import struct
import sys
import threading
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from flown_lines import FlownLines
from numpy.typing import NDArray

from airl_mav.camera.frame import Frame
from airl_mav.core.clock import SimClock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import EXIT_NOT_MET, EXIT_USAGE, UsageError
from airl_mav.core.frames import quat_from_euler, quat_to_euler
from airl_mav.core.machine import provenance
from airl_mav.core.progress import new_console
from airl_mav.flight.trajectory import Trajectory
from airl_mav.lockstep.stage import LockstepStage
from airl_mav.lockstep.vehicle import MemoryCamera, VehicleEnd, builtin_vehicle
from airl_mav.policy.registry import find_policy
from airl_mav.rehearsal.episode import part_of
from airl_mav.rehearsal.firmware_process import episode_setup
from airl_mav.report.document import Column, TableView, print_table, write_table
from airl_mav.scenario.checks import TRANSPORT_US
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import ResolvedScenario, resolve
from airl_mav.training.config import check_seeds
from companion.pilot import Mission, MissionResult, fly_mission
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.mavlink import codec
from firmware_sim.simulation import CrashDetector, Simulation
from published.record import behaviour_today

Vector = NDArray[np.float64]

ARENA, POLICY = "static-obstacles", "greedy"
FLIGHTS_FILE = "flights.csv"

FOUND_S, MOVED_M = 2.0, 2.0
"""Bounds of the study: time until a lie is found [s], and distance off the honest path [m]."""

PHASES = ("idle", "take-off", "cruise", "near goal", "landing")

HEALTHY_S, CLIMBED_S, CRUISED_S, LANDED_S = 0.25, 2.0, 1.0, 0.5
"""Onset before arming, and after the start of take-off, navigation and landing [s]."""

NEAR_M = 8.0
"""Distance to the goal at the onset near the goal [m]."""

WATCHDOG = re.compile(r"watchdog at ([0-9.]+) s")
"""Note of the watchdog, which stops the vehicle when no frame comes."""

HONEST_ENDS = ("goal reached", "stopped")
"""Reasons of a mission's end that find no lie."""


# --- man in the middle: messages

WIRE: Mapping[str, tuple[str, Mapping[str, slice]]] = {
    "LOCAL_POSITION_NED": (
        "<I6f",
        {"time_ms": slice(0, 1), "position": slice(1, 4), "velocity": slice(4, 7)},
    ),
    "ATTITUDE_QUATERNION": (
        "<I7f",
        {"time_ms": slice(0, 1), "quaternion": slice(1, 5), "rates": slice(5, 8)},
    ),
    "ATTITUDE": ("<I6f", {"time_ms": slice(0, 1), "euler": slice(1, 4), "rates": slice(4, 7)}),
    "HEARTBEAT": ("<I5B", {"mode": slice(0, 1), "base_mode": slice(3, 4)}),
    "EXTENDED_SYS_STATE": ("<2B", {"landed": slice(1, 2)}),
    "BATTERY_STATUS": ("<2ih10Hh3Bb", {"charge": slice(17, 18)}),
    "SYS_STATUS": ("<3I2Hh6Hb", {"charge": slice(12, 13)}),
}
"""Wire format of each message that the companion reads, and its fields."""

NAME_OF = {codec.layout(name).id_bytes: name for name in WIRE}

MOTION = ("LOCAL_POSITION_NED",)
ATTITUDE = ("ATTITUDE_QUATERNION", "ATTITUDE")

Change = Callable[[Vector, Vector, float], Vector]
"""Map from a field, the field at the onset and the time since the onset [s] to the false field."""


@dataclass(frozen=True)
class Lie:
    """False values of some messages, or of the frames."""

    what: str
    """Field or property."""
    how: str
    """Kind of the lie."""
    changes: tuple[tuple[str, Change], ...] = ()
    """Changed fields."""
    messages: tuple[str, ...] = ()
    """Messages whose time `source` changes."""
    source: Callable[[float], float] | None = None
    """Map from the time since the onset to the time of the message sent instead [s]."""
    frame: Callable[[Frame, Frame, float], Frame | None] | None = None
    """Map from a frame, the frame at the onset and the time since the onset [s]; None = lost."""
    late_s: float = 0.0
    """Additional transport time of frames [s]."""

    @property
    def name(self) -> str:
        """Return field and kind."""
        return f"{self.what} {self.how}"


def wrong(what: str, how: str, field_name: str, change: Change) -> Lie:
    """Return a lie about one field."""
    return Lie(what, how, ((field_name, change),))


def axis(index: int, change: Callable[[float, float, float], float]) -> Change:
    """Return the change of one number of a field."""

    def changed(now: Vector, then: Vector, s: float) -> Vector:
        out = now.copy()
        out[index] = change(float(now[index]), float(then[index]), s)
        return out

    return changed


def pictured(how: str, change: Callable[[Any, Any], Any]) -> Lie:
    """Return a lie about the pixels."""
    return Lie("image", how, frame=lambda f, t, s: replace(f, image=change(f.image, t.image)))


def stamped(how: str, change: Callable[[Frame, Frame, float], int]) -> Lie:
    """Return a lie about the capture time."""
    return Lie(
        "frame stamp", how, frame=lambda f, t, s: replace(f, capture_time_us=change(f, t, s))
    )


def numbered(how: str, change: Callable[[Frame, Frame], int]) -> Lie:
    """Return a lie about the sequence number."""
    return Lie("frame sequence", how, frame=lambda f, t, s: replace(f, sequence=change(f, t)))


def focused(how: str, focal: float) -> Lie:
    """Return a lie about the focal length [px]."""
    return Lie(
        "focal length",
        how,
        frame=lambda f, t, s: replace(f, intrinsics=replace(f.intrinsics, focal=focal)),
    )


def cropped(frame: Frame, then: Frame, s: float) -> Frame:
    """Return a frame of half the height."""
    half = frame.intrinsics.height // 2
    return replace(
        frame, image=frame.image[:half], intrinsics=replace(frame.intrinsics, height=half)
    )


REPLAY_S = 2.0
"""Length of a replayed sequence [s]."""


def replayed(s: float) -> float:
    """Return the time of the message that is sent again."""
    return s % REPLAY_S - REPLAY_S


TURNS_RAD_S = 20.0 * math.pi
"""Ten turns a second."""

HOLD_MODE = float(Mode.HOLD.spec.custom_mode)
ARMED = 128.0


def catalogue() -> Iterator[Lie]:
    """Yield all lies."""
    kinds: dict[str, Callable[[float, float, float], float]] = {
        "frozen": lambda n, t, s: t,
        "jumps 10 m": lambda n, t, s: n + 10.0,
        "drifts 3 m/s": lambda n, t, s: n + 3.0 * s,
        "creeps 1 m/s": lambda n, t, s: n + s,
        "creeps 0.2 m/s": lambda n, t, s: n + 0.2 * s,
    }
    for index, name, hows in (
        (0, "north position", tuple(kinds)),
        (1, "east position", ("jumps 10 m", "creeps 1 m/s")),
        (2, "depth", ("frozen", "drifts 3 m/s", "creeps 1 m/s", "creeps 0.2 m/s")),
    ):
        for how in hows:
            yield wrong(name, how, "position", axis(index, kinds[how]))
    yield wrong("height", "jumps +100 m", "position", axis(2, lambda n, t, s: n - 100.0))
    yield wrong("height", "jumps -100 m", "position", axis(2, lambda n, t, s: n + 100.0))
    yield wrong("height", "creeps 1 m/s", "position", axis(2, lambda n, t, s: n - s))
    yield wrong("position", "scaled 1.5", "position", lambda n, t, s: 1.5 * n)
    yield wrong("position", "mirrored", "position", lambda n, t, s: -n)
    yield wrong("position", "NaN", "position", lambda n, t, s: math.nan * n)
    for index, name in ((0, "north velocity"), (2, "vertical velocity")):
        yield wrong(name, "frozen", "velocity", axis(index, lambda n, t, s: t))
        yield wrong(name, "jumps 5 m/s", "velocity", axis(index, lambda n, t, s: n + 5.0))
    yield wrong("north velocity", "drifts 1 m/s2", "velocity", axis(0, lambda n, t, s: n + s))
    yield wrong("velocity", "doubled", "velocity", lambda n, t, s: 2.0 * n)
    yield wrong("velocity", "mirrored", "velocity", lambda n, t, s: -n)
    yield wrong("velocity", "NaN", "velocity", lambda n, t, s: math.nan * n)
    yield Lie("position and velocity", "late 0.5 s", (), MOTION, lambda s: s - 0.5)
    yield Lie("position and velocity", "late 1.5 s", (), MOTION, lambda s: s - 1.5)
    yield Lie("position and velocity", "ever later", (), MOTION, lambda s: 0.5 * s)
    yield Lie("position and velocity", "replayed", (), MOTION, replayed)
    yield Lie(
        *("position and velocity", "drift north 1 m/s together"),
        (
            ("position", axis(0, lambda n, t, s: n + s)),
            ("velocity", axis(0, lambda n, t, s: n + 1.0)),
        ),
    )
    yield Lie(
        *("position and velocity", "drift down 0.5 m/s together"),
        (
            ("position", axis(2, lambda n, t, s: n + 0.5 * s)),
            ("velocity", axis(2, lambda n, t, s: n + 0.5)),
        ),
    )
    yield wrong("pitch", "frozen", "euler", axis(1, lambda n, t, s: t))
    yield wrong("heading", "frozen", "euler", axis(2, lambda n, t, s: t))
    yield wrong("roll", "jumps 180 deg", "euler", axis(0, lambda n, t, s: n + math.pi))
    yield wrong("pitch", "jumps 30 deg", "euler", axis(1, lambda n, t, s: n + math.pi / 6.0))
    yield wrong("heading", "jumps 90 deg", "euler", axis(2, lambda n, t, s: n + math.pi / 2.0))
    yield wrong("heading", "drifts 45 deg/s", "euler", axis(2, lambda n, t, s: n + s * math.pi / 4))
    yield wrong("heading", "creeps 5 deg/s", "euler", axis(2, lambda n, t, s: n + s * math.pi / 36))
    yield wrong("heading", "mirrored", "euler", axis(2, lambda n, t, s: -n))
    yield wrong("heading", "ten turns/s", "euler", axis(2, lambda n, t, s: n + TURNS_RAD_S * s))
    yield wrong("attitude", "frozen", "euler", lambda n, t, s: t)
    yield wrong("attitude", "NaN", "quaternion", lambda n, t, s: math.nan * n)
    yield Lie("attitude", "late 0.5 s", (), ATTITUDE, lambda s: s - 0.5)
    yield Lie("attitude", "late 1.5 s", (), ATTITUDE, lambda s: s - 1.5)
    yield Lie("attitude", "replayed", (), ATTITUDE, replayed)
    yield wrong("body rates", "frozen", "rates", lambda n, t, s: t)
    yield wrong("body rates", "mirrored", "rates", lambda n, t, s: -n)
    yield wrong("body rates", "NaN", "rates", lambda n, t, s: math.nan * n)
    yield wrong("yaw rate", "ten turns/s", "rates", axis(2, lambda n, t, s: n + TURNS_RAD_S))
    yield wrong("time stamp", "frozen", "time_ms", lambda n, t, s: t)
    yield wrong("time stamp", "jumps 10 s", "time_ms", lambda n, t, s: n + 10_000.0)
    yield Lie("all telemetry", "frozen", (), (*MOTION, *ATTITUDE), lambda s: 0.0)
    yield Lie("all telemetry", "late 0.5 s", (), (*MOTION, *ATTITUDE), lambda s: s - 0.5)
    yield Lie("all telemetry", "late 1.5 s", (), (*MOTION, *ATTITUDE), lambda s: s - 1.5)
    yield Lie("all telemetry", "ever later", (), (*MOTION, *ATTITUDE), lambda s: 0.5 * s)
    yield Lie("all telemetry", "replayed", (), (*MOTION, *ATTITUDE), replayed)
    yield wrong("mode", "hold", "mode", lambda n, t, s: 0.0 * n + HOLD_MODE)
    yield wrong("mode", "frozen", "mode", lambda n, t, s: t)
    yield wrong("armed", "cleared", "base_mode", lambda n, t, s: n % ARMED)
    yield wrong("landed state", "on ground", "landed", lambda n, t, s: 0.0 * n + 1.0)
    yield wrong("charge", "jumps to 5 %", "charge", lambda n, t, s: 0.0 * n + 5.0)
    yield wrong("charge", "unknown", "charge", lambda n, t, s: 0.0 * n - 1.0)
    yield pictured("frozen", lambda n, t: t)
    yield pictured("without returns", lambda n, t: 0 * n)
    yield pictured("all far", lambda n, t: 0 * n + 20_000)
    yield pictured(
        "scaled 2", lambda n, t: np.minimum(2 * n.astype(np.int64), 65_535).astype(n.dtype)
    )
    yield pictured("mirrored", lambda n, t: n[:, ::-1])
    yield Lie("frames", "late 1 s", late_s=1.0)
    yield Lie("frames", "late 3 s", late_s=3.0)
    yield Lie("frames", "lost", frame=lambda f, t, s: None)
    yield stamped("frozen", lambda f, t, s: t.capture_time_us)
    yield stamped("jumps 5 s", lambda f, t, s: f.capture_time_us - 5 * US_PER_S)
    yield stamped("ever later", lambda f, t, s: f.capture_time_us - round(0.5 * s * US_PER_S))
    yield numbered("frozen", lambda f, t: t.sequence)
    yield numbered("backwards", lambda f, t: 2 * t.sequence - f.sequence)
    yield focused("64 px", 64.0)
    yield focused("NaN", math.nan)
    yield Lie("image height", "halved", frame=cropped)


LIES: tuple[Lie, ...] = tuple(catalogue())


class ManInTheMiddle(VehicleEnd):
    """End of the companion's link that changes the vehicle's messages."""

    answers_later = False

    def __init__(self, end: VehicleEnd, clock: SimClock, lie: Lie | None, onset_us: int) -> None:
        """Set the real end, the clock, the lie, None = honest, and its onset [µs]."""
        self._end, self._clock, self._lie, self._onset_us = end, clock, lie, onset_us
        self._then: dict[tuple[str, str], Vector] = {}
        """Fields at the onset, by message and field."""
        self._earlier: dict[str, tuple[list[int], list[bytes]]] = {}
        """Times [µs] and frames, by message."""
        self._sent_us: dict[str, int] = {}

    def deliver(self, frame: bytes, carry_out: Callable[[], object], *, echo: bool) -> None:
        """Deliver a frame of the companion unchanged."""
        self._end.deliver(frame, carry_out, echo=echo)

    def settle(self) -> None:
        """Wait for the vehicle."""
        self._end.settle()

    def take(self) -> list[bytes]:
        """Return the vehicle's frames, with the lie."""
        frames = self._end.take()
        if self._lie is None or not frames:
            return frames
        now_us = self._clock.time_us()
        passed = (self._pass(self._lie, frame, now_us) for frame in frames)
        return [frame for frame in passed if frame is not None]

    def _pass(self, lie: Lie, frame: bytes, now_us: int) -> bytes | None:
        name = NAME_OF.get(frame[7:10])
        if name is None:
            return frame
        s = (now_us - self._onset_us) / US_PER_S
        if name in lie.messages and lie.source is not None:
            times_us, frames = self._earlier.setdefault(name, ([], []))
            times_us.append(now_us)
            frames.append(frame)
            if s < 0.0:
                self._sent_us[name] = now_us
                return frame
            return self._instead(name, frame, lie.source(s), again=lie.source is replayed)
        if s < 0.0 or not lie.changes:
            return frame
        return self._changed(name, frame, lie.changes, s)

    def _instead(self, name: str, frame: bytes, s: float, *, again: bool) -> bytes | None:
        """Return the newest frame of a time relative to the onset [s]; None = sent already."""
        times_us, frames = self._earlier[name]
        k = bisect_right(times_us, self._onset_us + round(s * US_PER_S)) - 1
        sent_us = self._sent_us.get(name, -1)
        if k < 0 or times_us[k] == sent_us or (times_us[k] < sent_us and not again):
            return None
        self._sent_us[name] = times_us[k]
        # Numbered like the frame that it replaces.
        return packed(name, frame, frames[k][10:-2])

    def _changed(
        self, name: str, frame: bytes, changes: Sequence[tuple[str, Change]], s: float
    ) -> bytes:
        form, places = WIRE[name]
        wire = struct.Struct(form)
        # Extension fields and trailing zeros stay as they are.
        content = frame[10 : 10 + frame[1]].ljust(wire.size, b"\0")
        values = list(wire.unpack_from(content))
        for key, change in changes:
            if key in places:
                kept = np.array(values[places[key]], float)
                values[places[key]] = self._false(name, key, change, kept, s).tolist()
            elif key == "euler" and "quaternion" in places:
                angles = np.array(quat_to_euler(np.array(values[places["quaternion"]])))
                false = quat_from_euler(*self._false(name, key, change, angles, s))
                values[places["quaternion"]] = false.tolist()
        whole = [v if c == "f" else round(v) for v, c in zip(values, letters(form), strict=True)]
        return packed(name, frame, wire.pack(*whole) + content[wire.size :])

    def _false(self, name: str, key: str, change: Change, kept: Vector, s: float) -> Vector:
        return change(kept, self._then.setdefault((name, key), kept), s)


@cache
def letters(form: str) -> str:
    """Return the type letter of each number of a struct format."""
    out, count = "", ""
    for sign in form.lstrip("<"):
        if sign.isdigit():
            count += sign
        else:
            out, count = out + sign * int(count or 1), ""
    return out


def packed(name: str, frame: bytes, payload: bytes) -> bytes:
    """Return a frame with another payload and the same sender and number."""
    encoder = codec.Encoder(frame[5], frame[6])
    encoder.sequence = frame[4]
    return encoder.frame(codec.layout(name), codec.trimmed(payload))


# --- one flight


def scenario() -> ResolvedScenario:
    """Return the scenario of all flights."""
    return resolve(Scenario(level="lockstep", arena=ARENA, policy=POLICY))


@dataclass
class Flown:
    """Flight of one seed, honest or not."""

    path: Trajectory
    result: MissionResult
    phases: dict[str, int] = field(default_factory=dict)
    """Start of each phase of the mission [µs]."""
    hit: str | None = None
    armed: bool = False
    """True if the motors run at the end."""


def fly(resolved: ResolvedScenario, seed: int, lie: Lie | None, onset_us: int) -> Flown:
    """Fly a mission with a man in the middle; no referee ends it."""
    built, crash = builtin_vehicle(SimClock()), CrashDetector()
    phases: dict[str, int] = {}
    results: list[MissionResult] = []
    stop = threading.Event()
    goal = resolved.arena_of(seed).goal_point
    # The stage makes its clock; the end gets it below.
    end = ManInTheMiddle(built.end, SimClock(), lie, onset_us)
    with LockstepStage(transport_us=TRANSPORT_US, vehicle=replace(built, end=end)) as stage:
        clock = stage.conductor.clock
        assert isinstance(clock, SimClock)
        end._clock = clock
        if lie is not None and (lie.frame is not None or lie.late_s):
            lie_about_frames(stage.camera, lie, onset_us)

        def look(simulation: Simulation) -> None:
            if crash.look(simulation):
                stop.set()
                stage.abandon.set()

        stage.firmware.on_ticks = look

        def announce(phase: str) -> None:
            phases[phase] = clock.time_us()

        def program() -> None:
            latency = resolved.latency_sampler(seed, native=False)
            mission = Mission.of(resolved, goal, resolved.fresh_policy(seed), latency, None)
            results.append(
                fly_mission(
                    *(stage.link, stage.camera, mission, stage.clock, stop, stage.abandon),
                    announce,
                    guard=stage.clock,
                )
            )

        simulation = stage.run(episode_setup(resolved, resolved.arena_of(seed), seed), program)
        path = Trajectory.from_arrays(part_of(simulation.arrays(), "trajectory"))
        armed = simulation.autopilot.flight.phase >= FlightPhase.GROUND
    return Flown(path, results[0], phases, crash.hit, armed)


def lie_about_frames(camera: MemoryCamera, lie: Lie, onset_us: int) -> None:
    """Change the frames that arrive from a camera, from the onset on."""
    arrived, transport_us = camera.arrived, camera.transport_us
    then: list[Frame] = []

    def changed(now_us: int) -> Frame | None:
        if now_us >= onset_us:
            camera.transport_us = transport_us + round(lie.late_s * US_PER_S)
        frame = arrived(now_us)
        if frame is None or lie.frame is None or frame.capture_time_us < onset_us:
            return frame
        # Rendered here, as a lazy frame cannot be changed.
        true = Frame(frame.sequence, frame.capture_time_us, frame.image, frame.intrinsics)
        if not then:
            then.append(true)
        return lie.frame(true, then[0], (frame.capture_time_us - onset_us) / US_PER_S)

    camera.arrived = changed  # type: ignore[method-assign]


def onset_of(phase: str, honest: Flown, goal: Sequence[float]) -> int:
    """Return the onset of a lie in a phase [µs]."""
    at = honest.phases
    if phase == "near goal":
        after = honest.path.between(at["navigating"], int(honest.path.time_us[-1]))
        away_m = np.hypot(*(after.position[:, :2] - np.array(goal[:2])).T)
        return int(after.time_us[np.argmax(away_m < NEAR_M)])
    name, later_s = {
        "idle": ("taking off", -HEALTHY_S),
        "take-off": ("taking off", CLIMBED_S),
        "cruise": ("navigating", CRUISED_S),
        "landing": ("landing", LANDED_S),
    }[phase]
    return at[name] + round(later_s * US_PER_S)


@dataclass(frozen=True)
class LieFlight:
    """Result of a flight with a lie."""

    lie: str
    phase: str
    seed: int
    found_s: float
    """Time from the onset to the companion's reaction [s]; NaN = not found. Before the navigation
    no policy flies: an earlier onset counts as the start of the navigation."""
    moved_m: float
    """Maximum distance off the honest path [m]; below the path it counts before the landing."""
    reason: str
    """Reason of the mission's end."""
    end: str
    """landed, or the body that was hit, or flying."""
    behaviour: str


COLUMNS = tuple(each.name for each in fields(LieFlight))


def compared(
    lie: Lie, phase: str, seed: int, honest: Flown, flown: Flown, onset_us: int, behaviour: str
) -> LieFlight:
    """Return the result of a flight beside the honest flight of its seed."""
    over_us = min(flown.phases.get("landing", 2**62), flown.phases["done"])
    seen_s = WATCHDOG.findall(" ".join(flown.result.notes))
    found_us = [round(float(each) * US_PER_S) for each in seen_s]
    if flown.result.reason not in HONEST_ENDS:
        found_us.append(over_us)
    since_us = max(onset_us, honest.phases["navigating"])
    found_s = max(0.0, (min(found_us) - since_us) / US_PER_S) if found_us else math.nan
    after = flown.path.time_us >= onset_us
    ours, path = flown.path.position[after], honest.path.position
    descends = flown.path.time_us[after] >= over_us
    apart_m = [off(place, path, below=not down) for place, down in zip(ours, descends, strict=True)]
    end = flown.hit or ("flying" if flown.armed else "landed")
    return LieFlight(
        *(lie.name, phase, seed, round(found_s, 2), round(max(apart_m, default=0.0), 2)),
        *(flown.result.reason, end, behaviour),
    )


def off(place: Vector, path: Vector, *, below: bool) -> float:
    """Return the distance of a place to a path [m]."""
    apart = place - path
    if not below:
        # During a landing only the distance aside and above counts.
        apart[:, 2] = np.minimum(apart[:, 2], 0.0)
    return float(np.sqrt((apart**2).sum(axis=1).min()))


# --- the matrix


@dataclass(frozen=True)
class Command:
    """Fly the lies and tabulate what the companion finds."""

    seeds: int = 5
    """Seeds for each lie and phase."""

    seed: int = 1
    """First seed; seeds whose honest flight misses the goal are skipped."""

    lies: tuple[str, ...] = ()
    """Words of the lies to fly; by default all."""

    phases: tuple[str, ...] = PHASES
    """Phases of the onset."""

    out: Path = Path("runs/telemetry-lies")
    """Folder of flights.csv and table.json."""


def honest_flights(resolved: ResolvedScenario, first: int, count: int) -> dict[int, Flown]:
    """Return the first honest flights that reach the goal, by seed."""
    flights: dict[int, Flown] = {}
    seed = first
    while len(flights) < count:
        flown = fly(resolved, seed, None, 0)
        if flown.result.reason == "goal reached":
            flights[seed] = flown
        seed += 1
    return flights


SLOW = "slower than an estimator's own drift"
AGREED = "all values agree, as in GPS drift"
DELAYED = "a delay below 1 s is load, and MAVSDK's position has no time stamp"
TURNED = "too slow or too fast for two checks a second"
TILTED = "a tilt that wind would explain"
SILENT = "telemetry and decisions may pause for 2 s"
POSSIBLE = "a possible image"

UNDETECTABLE: Mapping[str, str] = {
    "north position creeps 0.2 m/s": SLOW,
    "position and velocity drift north 1 m/s together": AGREED,
    "position and velocity drift down 0.5 m/s together": AGREED,
    "position and velocity replayed": AGREED,
    "position and velocity late 0.5 s": DELAYED,
    "position and velocity late 1.5 s": DELAYED,
    "position and velocity ever later": DELAYED,
    "attitude late 0.5 s": DELAYED,
    "all telemetry late 0.5 s": DELAYED,
    "frames late 1 s": DELAYED,
    "heading drifts 45 deg/s": TURNED,
    "heading creeps 5 deg/s": TURNED,
    "heading ten turns/s": TURNED,
    "frame sequence frozen": SILENT,
    "all telemetry ever later": DELAYED,
    "pitch jumps 30 deg": TILTED,
    "all telemetry frozen": SILENT,
    "image scaled 2": POSSIBLE,
}
"""Reason for each lie that moves the vehicle and is not found in time."""


def is_missed(row: Mapping[str, str]) -> bool:
    """Return True if a flight was moved too far without a timely end."""
    # To a tenth of a second: the fourth check of a policy at 2 Hz comes after 2.004 s.
    found_s = round(float(row["found_s"]), 1)
    return float(row["moved_m"]) > MOVED_M and not found_s <= FOUND_S


def cell(rows: Sequence[Mapping[str, str]]) -> str:
    """Return the flights of a lie in a phase: longest time, largest distance, ends."""
    if not rows:
        return ""
    times = [float(row["found_s"]) for row in rows]
    missed = sum(map(math.isnan, times))
    longest = "not found" if missed == len(rows) else f"{np.nanmax(times):.1f} s"
    longest += f" ({missed} not)" if 0 < missed < len(rows) else ""
    ends = Counter(
        "landed" if row["end"] == "landed" else "hit" if row["end"] != "flying" else "flying"
        for row in rows
    )
    parts = ", ".join(
        end if count == len(rows) else f"{count} {end}" for end, count in ends.most_common()
    )
    return f"{longest}; {max(float(row['moved_m']) for row in rows):.1f} m; {parts}"


def view_of(rows: Sequence[Mapping[str, str]]) -> TableView:
    """Return the matrix: a row per lie, a column per phase."""
    lines = []
    for lie in LIES:
        mine = [row for row in rows if row["lie"] == lie.name]
        if not mine:
            continue
        cells = [cell([row for row in mine if row["phase"] == phase]) for phase in PHASES]
        late = any(map(is_missed, mine))
        lines.append((lie.what, lie.how, *cells, UNDETECTABLE.get(lie.name, "!") if late else ""))
    columns = (
        Column("field", number=False),
        Column("lie", number=False),
        *(Column(phase, number=False) for phase in PHASES),
        Column("not found in time because", number=False),
    )
    return TableView("lies", "False telemetry", columns, tuple(lines), in_terminal="stacked")


def main(words: Sequence[str] | None = None) -> int:
    """Fly the missing flights and tabulate all."""
    asked, console = tyro.cli(Command, args=words, description=__doc__), new_console()
    check_seeds(asked.seed, asked.seeds)
    behaviour = behaviour_today()
    path = asked.out / FLIGHTS_FILE
    lines = FlownLines(path, COLUMNS)
    if {row["behaviour"] for row in lines.rows} - {behaviour}:
        raise UsageError(f"{path}: flown with another behaviour; accepted: {behaviour}")
    resolved = scenario()
    honest = honest_flights(resolved, asked.seed, asked.seeds)
    known = {(row["lie"], row["phase"], int(row["seed"])) for row in lines.rows}
    lies = [lie for lie in LIES if not asked.lies or any(word in lie.name for word in asked.lies)]
    for seed, lie, phase in product(honest, lies, asked.phases):
        if (lie.name, phase, seed) in known:
            continue
        onset_us = onset_of(phase, honest[seed], resolved.arena_of(seed).goal_point)
        flown = fly(resolved, seed, lie, onset_us)
        lines.add(asdict(compared(lie, phase, seed, honest[seed], flown, onset_us, behaviour)))
    view = view_of(lines.rows)
    print_table(view, console)
    words = sys.argv[1:] if words is None else words
    command = shlex.join(["python", "scripts/telemetry_lies.py", *words])
    write_table(view, asked.out, provenance(command), [find_policy(POLICY).name])
    unlisted = {row["lie"] for row in lines.rows if is_missed(row)} - UNDETECTABLE.keys()
    for name in sorted(unlisted):
        console.print(f"not found in time, and not listed: {name}", highlight=False)
    return EXIT_NOT_MET if unlisted else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except UsageError as error:
        sys.stderr.write(f"telemetry_lies.py: {error}\n")
        sys.exit(EXIT_USAGE)
